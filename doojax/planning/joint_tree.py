"""Two trees of joint positions that grow towards each other, in arrays of fixed length: RRT-Connect.

Kuffner and LaValle 2000. Joints are drawn, and a line goes from the nearest node of one tree straight towards
them, for at most a certain length. If all of it is free its end is a node, and lines go from the other tree's
nearest node straight to that, until one is not free or they meet. Then it is the other tree's turn.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from doojax.planning.joint_lines import Line, Outcome, line_to

SPREADS = (0.3, 0.8, 1.5)  # rad, around the straight way, of joints that are drawn
ANYWHERE = 0.2  # of joints are drawn evenly within their bounds
AT_ROOT = 0.05  # are the other tree's root


class MotionQuery(eqx.Module):
    """From where to where joints are to go, and within which bounds."""

    start: Float[Array, "*b J"]  # rad or m
    goals: Float[Array, "*b G J"]  # any of them will do
    active: Bool[Array, "*b G"]  # which of them count
    low: Float[Array, "*b J"]  # of all joints on the way
    high: Float[Array, "*b J"]


class Lengths(eqx.Module):
    """How lines of a search are."""

    longest: float = eqx.field(static=True)  # rad, that a joint moves on one
    step: float = eqx.field(static=True)  # rad, that a joint moves between two places on it


class JointSearch(eqx.Module):
    """Tree 0 grows from the start and tree 1 from the goals."""

    joints: Float[Array, "*b 2 N J"]
    parents: Int[Array, "*b 2 N"]  # -1 for roots
    used: Bool[Array, "*b 2 N"]
    count: Int[Array, "*b 2"]
    line: Line  # that is being checked
    tree: Int[Array, "*b"]  # whose it is
    near: Int[Array, "*b"]  # the node where it begins
    aim: Float[Array, "*b J"]  # where it goes, which may be farther away
    aimed: Int[Array, "*b"]  # the node of the other tree there; -1 where joints were drawn
    turn: Int[Array, "*b"]  # the tree that drew joints last
    met: Int[Array, "*b 2"]  # the nodes of each tree where they met, equal; -1 before
    drawn: Int[Array, "*b"]  # how often joints were
    checks: Int[Array, "*b"]  # joint positions that were asked whether they are free
    most: Int[Array, "*b"]  # of them; none for a query without a goal
    margin: Float[Array, "*b"]  # m

    @property
    def going(self) -> Bool[Array, "*b"]:
        """Whether the trees have not met, and there is room and time for more."""
        room = (self.count < self.used.shape[-1]).all(-1)
        return (self.met[..., 0] < 0) & room & (self.checks < self.most)


def begun(
    query: MotionQuery, lengths: Lengths, nodes: int, most: int, margin: float, key: Key[Array, ""]
) -> JointSearch:
    """The search of one query: trees of roots alone, and the line from the start to the nearest goal."""
    goals, size = query.goals.shape
    joints = jnp.zeros((2, nodes, size), query.start.dtype)
    joints = joints.at[0, 0].set(query.start).at[1, :goals].set(query.goals)
    used = jnp.zeros((2, nodes), bool).at[0, 0].set(True).at[1, :goals].set(query.active)
    zero = jnp.zeros((), int)
    search = JointSearch(
        joints=joints,
        parents=jnp.full((2, nodes), -1),
        used=used,
        count=jnp.array([1, goals]),
        line=line_to(query.start, query.start, lengths.step),
        tree=zero,
        near=zero,
        aim=query.start,
        aimed=zero - 1,
        turn=zero + 1,
        met=jnp.full(2, -1),
        drawn=zero,
        checks=zero,
        most=jnp.where(query.active.any(), most, 0),
        margin=jnp.full((), margin, query.start.dtype),
    )
    nothing = Outcome(zero, zero, jnp.array(True), jnp.array(False))  # so that a line is begun
    return grown(query, search, nothing, lengths, key)


def grown(
    query: MotionQuery, search: JointSearch, outcome: Outcome, lengths: Lengths, key: Key[Array, ""]
) -> JointSearch:
    """The search after some places of its line were asked."""
    going, line, tree = search.going, search.line, search.tree
    passed, failed = outcome.passed & going, outcome.failed & going
    connects, there = search.aimed >= 0, jnp.all(line.end == search.aim)
    new = search.count[tree]
    place = jnp.where(passed, new, search.used.shape[-1])  # beyond the end: dropped
    joints = search.joints.at[tree, place].set(line.end, mode="drop")
    used = search.used.at[tree, place].set(True, mode="drop")
    met = jnp.where(
        passed & connects & there, jnp.where(jnp.arange(2) == tree, new, search.aimed), search.met
    )

    draws, onward = failed, passed & connects
    turn = jnp.where(draws, 1 - search.turn, search.turn)
    drawn = _drawn(query, search, turn, jax.random.fold_in(key, search.drawn))
    next_tree = jnp.where(draws, turn, jnp.where(onward, tree, 1 - tree))
    aim = jnp.where(draws, drawn, jnp.where(connects, search.aim, line.end))
    aimed = jnp.where(draws, -1, jnp.where(connects, search.aimed, new))
    near = jnp.where(onward, new, _nearest(joints[next_tree], used[next_tree], aim))
    begin = joints[next_tree, near]
    far = jnp.max(jnp.abs(aim - begin))
    touches = passed & ~connects & jnp.all(begin == aim)  # the line led to a root of the other tree
    met = jnp.where(touches, jnp.where(jnp.arange(2) == tree, new, near), met)
    part = begin + jnp.minimum(1.0, lengths.longest / jnp.maximum(far, 1e-9)) * (aim - begin)
    following = line_to(begin, jnp.where(far <= lengths.longest, aim, part), lengths.step)

    ended = passed | failed
    left = eqx.tree_at(lambda one: one.asked, line, line.asked + jnp.where(going, outcome.asked, 0))
    after = following, next_tree, near, aim, aimed, turn
    before = left, tree, search.near, search.aim, search.aimed, search.turn
    return eqx.tree_at(
        lambda s: (
            *(s.joints, s.parents, s.used, s.count, s.met, s.drawn, s.checks),
            *(s.line, s.tree, s.near, s.aim, s.aimed, s.turn),
        ),
        search,
        (
            joints,
            search.parents.at[tree, place].set(search.near, mode="drop"),
            used,
            search.count.at[tree].add(passed),
            met,
            search.drawn + draws,
            search.checks + jnp.where(going, outcome.asked, 0),
            *jax.tree.map(lambda new, old: jnp.where(ended, new, old), after, before),
        ),
    )


def _drawn(query: MotionQuery, search: JointSearch, turn: Array, key: Array) -> Float[Array, "J"]:
    """Joints to grow towards: first the goal that is nearest to the start, then such around the straight way.

    Motions that go far around are rare, and joints that are drawn evenly are nearly always far from anywhere
    of use; some are all the same, so that nothing is out of reach.
    """
    keys = iter(jax.random.split(key, 6))
    low, high, start = query.low, query.high, query.start
    square = ((query.goals - start) ** 2).sum(-1)
    nearest = jnp.argmin(jnp.where(query.active, square, jnp.inf))
    first = search.drawn == 0
    likely = jnp.where(query.active, 0.0, -jnp.inf)
    goal = query.goals[jnp.where(first, nearest, jax.random.categorical(next(keys), likely))]
    spread = jax.random.choice(next(keys), jnp.array(SPREADS, start.dtype))
    spread = jnp.minimum(spread, (high - low) / 4)
    way = start + jax.random.uniform(next(keys), (), start.dtype) * (goal - start)
    around = jnp.clip(way + spread * jax.random.normal(next(keys), start.shape, start.dtype), low, high)
    anywhere = jax.random.uniform(next(keys), start.shape, start.dtype, low, high)
    choice = jax.random.uniform(next(keys))
    joints = jnp.where(choice < ANYWHERE, anywhere, around)
    root = jnp.where(turn == 0, goal, start)
    return jnp.where(first | (choice > 1 - AT_ROOT), root, joints)


def _nearest(joints: Float[Array, "N J"], used: Bool[Array, "N"], to: Float[Array, "J"]) -> Int[Array, ""]:
    return jnp.argmin(jnp.where(used, ((joints - to) ** 2).sum(-1), jnp.inf))
