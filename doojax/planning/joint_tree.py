"""Two trees of joint positions that grow towards each other, in arrays of fixed length: RRT-Connect's step.

Kuffner and LaValle 2000. One step draws joints, goes from the nearest node of one tree straight towards them
until something is in the way, and from the other tree's nearest node straight to where that ended.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

type Free = Callable[[Float[Array, "J"]], Bool[Array, ""]]


class MotionQuery(eqx.Module):
    """From where to where joints are to go, and within which bounds."""

    start: Float[Array, "*b J"]  # rad or m
    goals: Float[Array, "*b G J"]  # any of them will do
    active: Bool[Array, "*b G"]  # which of them count
    low: Float[Array, "*b J"]  # of all joints on the way
    high: Float[Array, "*b J"]


class JointTrees(eqx.Module):
    """Tree 0 grows from the start and tree 1 from the goals."""

    joints: Float[Array, "*b 2 N J"]
    parents: Int[Array, "*b 2 N"]  # -1 for roots
    used: Bool[Array, "*b 2 N"]
    count: Int[Array, "*b 2"]
    turn: Int[Array, "*b"]  # the tree whose turn it is
    met: Int[Array, "*b 2"]  # the nodes of each tree where they met, equal; -1 before
    steps: Int[Array, "*b"]
    checks: Int[Array, "*b"]  # joint positions that were asked whether they are free

    @property
    def done(self) -> Bool[Array, "*b"]:
        """Whether the trees met, or one is full."""
        return (self.met[..., 0] >= 0) | (self.count >= self.used.shape[-1]).any(-1)


def roots(query: MotionQuery, nodes: int) -> JointTrees:
    """Trees of one query that have only roots."""
    goals, size = query.goals.shape
    joints = jnp.zeros((2, nodes, size), query.start.dtype)
    joints = joints.at[0, 0].set(query.start).at[1, :goals].set(query.goals)
    used = jnp.zeros((2, nodes), bool).at[0, 0].set(True).at[1, :goals].set(query.active)
    zero = jnp.zeros((), int)
    return JointTrees(
        joints, jnp.full((2, nodes), -1), used, jnp.array([1, goals]), zero, jnp.full(2, -1), zero, zero
    )


def grown(
    query: MotionQuery, trees: JointTrees, free: Free, step: float, points: int, key: Key[Array, ""]
) -> JointTrees:
    """The trees after one step; ``points`` are checked on each straight line, at most ``step`` apart."""
    here, there = trees.turn, 1 - trees.turn

    def go(
        now: tuple[JointTrees, Array], tree: Array
    ) -> tuple[tuple[JointTrees, Array], tuple[Array, Array]]:
        trees, aim = now
        near = _nearest(trees, tree, aim)
        begin = trees.joints[tree, near]
        end, reached = _straight(begin, aim, free, step, points)
        moved = jnp.any(end != begin)
        trees = _added(trees, tree, near, end, moved)
        return (trees, end), (jnp.where(moved, trees.count[tree] - 1, near), reached | jnp.all(begin == aim))

    both = jnp.stack([here, there])  # a loop, so that it is compiled once
    (trees, _), (nodes, reached) = jax.lax.scan(go, (trees, _drawn(query, trees, there, key)), both)
    met = jnp.where(reached[1], nodes[both], trees.met)  # ``both`` is its own inverse
    return eqx.tree_at(
        lambda t: (t.turn, t.met, t.steps, t.checks),
        trees,
        (there, met, trees.steps + 1, trees.checks + 2 * points),
    )


def _drawn(query: MotionQuery, trees: JointTrees, there: Array, key: Array) -> Float[Array, "J"]:
    """Joints within the bounds; every other time the other tree's last, so that a way that is begun goes on.

    At first, and now and then, it is a root of the other tree.
    """
    for_joints, for_root, for_choice = jax.random.split(key, 3)
    joints = jax.random.uniform(for_joints, query.start.shape, query.start.dtype, query.low, query.high)
    likely = jnp.where(query.active, 0.0, -jnp.inf)
    root = jnp.where(there == 0, 0, jax.random.categorical(for_root, likely))
    choice = jax.random.uniform(for_choice)
    to_root = (trees.steps < 2) | (choice < 0.05)
    node = jnp.where(to_root, root, trees.count[there] - 1)
    return jnp.where(to_root | (choice < 0.5), trees.joints[there, node], joints)


def _nearest(trees: JointTrees, tree: Array, joints: Float[Array, "J"]) -> Int[Array, ""]:
    square = ((trees.joints[tree] - joints) ** 2).sum(-1)
    return jnp.argmin(jnp.where(trees.used[tree], square, jnp.inf))


def _straight(
    begin: Float[Array, "J"], end: Float[Array, "J"], free: Free, step: float, points: int
) -> tuple[Float[Array, "J"], Bool[Array, ""]]:
    """How far one gets from ``begin`` towards ``end``, and whether one gets there."""
    longest = jnp.max(jnp.abs(end - begin))
    part = jnp.minimum(1.0, points * step / jnp.maximum(longest, 1e-9))
    fractions = part * jnp.arange(1, points + 1) / points
    passed = jax.vmap(free)(begin + fractions[:, None] * (end - begin))
    count = jnp.cumprod(passed).sum()
    to = begin + jnp.where(count > 0, fractions[count - 1], 0.0) * (end - begin)
    whole = (count == points) & (part >= 1)
    return jnp.where(whole, end, to), whole


def _added(trees: JointTrees, tree: Array, parent: Array, joints: Array, wanted: Array) -> JointTrees:
    """With one more node, unless it is not wanted."""
    place = jnp.where(wanted, trees.count[tree], trees.used.shape[-1])  # beyond the end: dropped
    return eqx.tree_at(
        lambda t: (t.joints, t.parents, t.used, t.count),
        trees,
        (
            trees.joints.at[tree, place].set(joints, mode="drop"),
            trees.parents.at[tree, place].set(parent, mode="drop"),
            trees.used.at[tree, place].set(True, mode="drop"),
            trees.count.at[tree].add(wanted),
        ),
    )
