"""Motions of a robot's joints past obstacles: many queries side by side, shortened, and timed.

`plan_motions` searches (see `doojax.planning.joint_tree`), shortens what it finds and checks it once more,
at more places. `repaired_start` moves joints that begin in slight collision out of it, and
`MotionPlan.at` says where joints are when.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from doojax.keys import numbered
from doojax.modules import Jittable
from doojax.parts import traced
from doojax.planning.joint_tree import Free, JointTrees, MotionQuery, grown, roots
from doojax.robots import Robot, clearance, is_free
from doojax.types import Obstacles

FARTHEST = float(np.deg2rad(280))  # that the thesis lets a joint move from where it starts, rad


@dataclass(frozen=True)
class MotionSettings:
    """How motions are searched for."""

    steps: int = 500  # of the search, at most
    nodes: int = 512  # of each tree, at most
    points: int = 16  # that are checked on each straight line of the search
    step: float = 0.06  # rad, the most that a joint moves between two of them
    margin: float = 0.005  # m, to be kept from all that must not be touched
    farthest: float = FARTHEST  # rad, that a joint may move from where it starts
    waypoints: int = 64  # of a motion, at most
    shortcuts: int = 16  # that are tried
    lanes: int = 32  # queries that are searched at once; others wait for their turn

    def __post_init__(self):
        """Refuse what finds nothing."""
        for name, value in vars(self).items():
            least = 0 if name in ("margin", "shortcuts") else 2 if name in ("nodes", "waypoints") else None
            if not (value > 0 if least is None else value >= least) or value > 1e6:
                wanted = "more than 0" if least is None else f"{least} or more"
                raise ValueError(f"{name} is {value}, expected {wanted}, and at most a million")


class MotionPlan(eqx.Module):
    """Straight lines between joint positions; of a failed search, the start alone."""

    waypoints: Float[Array, "*b W J"]  # rad or m; after the last they repeat it
    count: Int[Array, "*b"]  # of waypoints
    times: Float[Array, "*b W"]  # s, when each is reached at the largest speeds
    solved: Bool[Array, "*b"]
    checks: Int[Array, "*b"]  # of joint positions that the search made

    def at(self, time: Float[Array, ""]) -> Float[Array, "J"]:
        """Joints at a time (s) of one plan: the first before it begins and the last after it ended."""
        return jax.vmap(partial(jnp.interp, time, self.times), 1)(self.waypoints)


class MotionPlanner(Jittable):
    """What motions are planned for."""

    robot: Robot
    obstacles: Obstacles
    moving: tuple[int, ...] = eqx.field(static=True)  # indices of the joints that may move
    floor: float | None = eqx.field(static=True, default=None)  # height, m
    settings: MotionSettings = eqx.field(static=True, default=MotionSettings())

    def query(self, start: Float[Array, "J"], goals: Float[Array, "G J"]) -> MotionQuery:
        """A query of those joints that move, within limits and `MotionSettings.farthest` of the start."""
        index = np.array(self.moving)
        begin = start[index]
        far = self.settings.farthest
        low, high = (
            jnp.maximum(self.robot.low[index], begin - far),
            jnp.minimum(self.robot.high[index], begin + far),
        )
        ends = goals[:, index]
        return MotionQuery(begin, ends, ((ends >= low) & (ends <= high)).all(-1), low, high)

    def free(self, start: Float[Array, "J"], margin: float | Float[Array, ""]) -> Free:
        """Whether joints that move are free, while the others stay as in ``start``."""
        index = np.array(self.moving)

        def one(values: Float[Array, "M"]) -> Bool[Array, ""]:
            joints = start.at[index].set(values)
            return is_free(self.robot, joints, self.obstacles, margin, self.floor)

        return one

    def check(self, start: Float[Array, "J"], goals: Float[Array, "G J"]) -> None:
        """Say what is wrong with a query, outside of jit.

        Raises:
            ValueError: the start is beyond the joints' limits or in collision, or every goal is, or is
                farther away than joints may move.
        """
        robot, index = self.robot, np.array(self.moving)
        joint = robot.beyond_limits(start)
        if joint is not None:
            raise ValueError(
                f"joint {robot.joints[joint]!r} starts at {float(start[joint]):.4g}, beyond its limits, "
                f"{float(robot.low[joint]):.4g} to {float(robot.high[joint]):.4g}"
            )
        depth = float(_distance(self, start))
        if depth <= self.settings.margin:
            raise ValueError(
                f"the start is {depth:.4g} m from what it must not touch, expected more than "
                f"{self.settings.margin} m: move it out with repaired_start, or ask for less margin"
            )
        near = np.asarray(self.query(start, goals).active)
        ends = [start.at[index].set(goal[index]) for goal in goals[near]]
        if not near.any():
            raise ValueError(
                f"none of {len(goals)} goals is within the joints' limits and "
                f"{np.rad2deg(self.settings.farthest):.0f} degrees of the start"
            )
        depths = [float(_distance(self, end)) for end in ends]
        if max(depths) <= self.settings.margin:
            raise ValueError(
                f"no goal is farther than {self.settings.margin} m from what must not be touched: the best "
                f"is {max(depths):.4g} m from it"
            )


@eqx.filter_jit
def plan_motions(
    planner: MotionPlanner,
    starts: Float[Array, "Q J"],
    goals: Float[Array, "Q G J"],
    key: Key[Array, ""],
) -> MotionPlan:
    """Motions of Q queries from free starts; goals that are not free are never met.

    Each query's result depends on its number and the key, not on the others.
    """
    settings = planner.settings
    queries = jax.vmap(planner.query)(starts, goals)
    keys = numbered(key, range(len(starts)))
    trees = jax.vmap(partial(roots, nodes=settings.nodes))(queries)

    def is_waiting(trees: JointTrees) -> Bool[Array, "Q"]:
        return ~trees.done & (trees.steps < settings.steps) & queries.active.any(-1)

    def advance(width: int, trees: JointTrees) -> JointTrees:
        lanes = jnp.nonzero(is_waiting(trees), size=width, fill_value=len(starts))[0]
        query, tree, start, own = jax.tree.map(
            lambda leaf: leaf.at[lanes].get(mode="clip"), (queries, trees, starts, keys)
        )

        def one(query: MotionQuery, tree: JointTrees, start: Array, key: Array) -> JointTrees:
            free = planner.free(start, settings.margin)
            key = jax.random.fold_in(key, tree.steps)
            return grown(query, tree, free, settings.step, settings.points, key)

        after = jax.vmap(one)(query, tree, start, own)
        return jax.tree.map(lambda all_, some: all_.at[lanes].set(some, mode="drop"), trees, after)

    # Lanes that wait for nobody compute all the same: the last few queries get fewer lanes.
    width, few = min(settings.lanes, len(starts)), settings.lanes // 8
    for lanes, left in ((width, few), (few, 0)) if 0 < few < width else ((width, 0),):
        trees = jax.lax.while_loop(
            lambda trees, left=left: is_waiting(trees).sum() > left, partial(advance, lanes), trees
        )
    return jax.lax.map(
        lambda query: _finished(planner, *query), (trees, starts, keys), batch_size=settings.lanes
    )


def _finished(planner: MotionPlanner, trees: JointTrees, start: Float[Array, "J"], key: Array) -> MotionPlan:
    """The way through the trees, shortened, checked and timed."""
    settings = planner.settings
    path, count, fits = _way(trees, settings.waypoints)
    shorten = jax.random.fold_in(key, settings.steps)
    path, count, whole = _shortened(path, count, partial(planner.free, start), settings, shorten)
    solved = fits & whole
    moving = np.array(planner.moving)
    path = jnp.where(solved, path, start[moving])
    every = jnp.broadcast_to(start, (settings.waypoints, len(start))).at[:, moving].set(path)
    longest = (jnp.abs(path[1:] - path[:-1]) / planner.robot.speed[moving]).max(-1)
    times = jnp.concatenate([jnp.zeros(1, longest.dtype), jnp.cumsum(longest)])
    return MotionPlan(every, jnp.where(solved, count, 1), times, solved, trees.checks)


def _way(trees: JointTrees, most: int) -> tuple[Float[Array, "W J"], Int[Array, ""], Bool[Array, ""]]:
    """The nodes from the start to a goal, how many there are, and whether they met and fit."""

    def climb(tree: int) -> tuple[Array, Array]:
        def up(node: Array, _: None) -> tuple[Array, Array]:
            return jnp.where(node >= 0, trees.parents[tree, node], -1), node

        _, nodes = jax.lax.scan(up, trees.met[tree], None, most)
        return nodes, (nodes >= 0).sum()

    (back, begun), (on, ended) = climb(0), climb(1)
    place = jnp.arange(most)
    count = begun + ended - 1  # the node where they met is in both
    first = trees.joints[0, back[jnp.clip(begun - 1 - place, 0, most - 1)]]
    second = trees.joints[1, on[jnp.clip(jnp.minimum(place, count - 1) - begun + 1, 0, most - 1)]]
    met = trees.met[0] >= 0
    rooted = (begun < most) & (ended < most)
    return jnp.where((place < begun)[:, None], first, second), count, met & rooted & (count <= most)


def _shortened(
    path: Float[Array, "W J"],
    count: Int[Array, ""],
    free: Callable[[Array], Free],
    settings: MotionSettings,
    key: Array,
) -> tuple[Float[Array, "W J"], Int[Array, ""], Bool[Array, ""]]:
    """Without waypoints between two that a straight line joins; and whether all that is left is free.

    Shortcuts are checked as densely as lines are in the search, and those once more at twice the places. A
    line too long for that is no shortcut. What is left need keep no margin.
    """
    place, shortcuts = jnp.arange(len(path)), settings.shortcuts
    fractions = jnp.linspace(0, 1, 2 * settings.points + 1)[:, None]
    longest = 2 * settings.points * settings.step

    def attempt(number: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        path, count, whole = now
        one, two = jax.random.randint(jax.random.fold_in(key, number), (2,), 0, jnp.maximum(count, 1))
        checks = number >= shortcuts
        first = jnp.where(checks, number - shortcuts, jnp.minimum(one, two))
        last = jnp.where(checks, first + 1, jnp.maximum(one, two))
        begin, end = path[first], path[last]
        is_free = free(jnp.where(checks, 0.0, settings.margin))
        passed = jax.vmap(is_free)(begin + fractions * (end - begin)).all()
        short = passed & (jnp.abs(end - begin).max() <= longest) & ~checks
        skipped = jnp.where(short, jnp.maximum(last - first - 1, 0), 0)
        moved = path[jnp.where(place > first, jnp.minimum(place + skipped, len(path) - 1), place)]
        return moved, count - skipped, whole & (passed | ~checks)

    def left(now: tuple[Array, tuple[Array, Array, Array]]) -> Bool[Array, ""]:
        number, (_, count, _) = now
        return number < shortcuts + count - 1

    def go_on(now: tuple[Array, tuple[Array, Array, Array]]) -> tuple[Array, tuple[Array, Array, Array]]:
        number, path = now
        return number + 1, attempt(number, path)

    begin = jnp.zeros((), int), (path, count, jnp.array(True))
    return jax.lax.while_loop(left, go_on, begin)[1]


def repaired_start(
    planner: MotionPlanner,
    start: Float[Array, "J"],
    key: Key[Array, ""],
    most: float = float(np.deg2rad(2)),
    rounds: int = 10,
    samples: int = 100,
) -> Float[Array, "J"]:
    """Joints near to ``start`` that are free: it itself if it is.

    In each round joints are moved by up to ``most`` (rad) at random, and the sample with the most clearance
    is where the next round begins, as long as none is free.

    Raises:
        ValueError: outside of jit, if none is found: the start is in deep collision.
    """
    margin = planner.settings.margin + 1e-4
    found, best = _repaired(planner, start, key, jnp.asarray(most, start.dtype), margin, rounds, samples)
    if not traced(best) and float(best) <= margin:
        raise ValueError(
            f"no start is free within {rounds} rounds of {np.rad2deg(most):.3g} degrees: the best is "
            f"{float(best):.4g} m from what it must not touch, expected {margin:.4g} m. Move the robot or "
            "the obstacle"
        )
    return found


@eqx.filter_jit
def _repaired(
    planner: MotionPlanner,
    start: Float[Array, "J"],
    key: Key[Array, ""],
    most: Float[Array, ""],
    margin: float,
    rounds: int,
    samples: int,
) -> tuple[Float[Array, "J"], Float[Array, ""]]:
    low, high, index = planner.robot.low, planner.robot.high, np.array(planner.moving)

    def go_on(now: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        number, joints, best = now
        own, shape = jax.random.fold_in(key, number), (samples, len(index))
        change = jax.random.uniform(own, shape, joints.dtype, -most, most)
        moves = jnp.zeros((samples, len(joints)), joints.dtype).at[:, index].set(change)
        tried = jnp.clip(joints + moves, low, high)
        distances = jax.lax.map(lambda one: _distance(planner, one), tried, batch_size=min(25, samples))
        there = jnp.argmax(distances)
        better = distances[there] > best
        found = jnp.where(better, tried[there], joints), jnp.where(better, distances[there], best)
        return number + 1, *found

    def is_caught(now: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        number, _, best = now
        return (number < rounds) & (best <= margin)

    begin = jnp.zeros((), int), start, _distance(planner, start)
    return jax.lax.while_loop(is_caught, go_on, begin)[1:]


@eqx.filter_jit
def _distance(planner: MotionPlanner, joints: Float[Array, "J"]) -> Float[Array, ""]:
    return clearance(planner.robot, joints, planner.obstacles, planner.floor)
