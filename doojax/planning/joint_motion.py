"""Motions of a robot's joints past obstacles: many queries side by side, shortened, and timed.

`plan_motions` searches (see `doojax.planning.joint_tree`), shortens what it finds
(`doojax.planning.joint_shortcut`) and makes sure that it is free everywhere, not at some places of it alone
(`doojax.planning.joint_sweep`). `repaired_start` moves joints that begin in slight collision out of it, and
`MotionPlan.at` says where joints are when.
"""

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
from doojax.planning.joint_lines import MOST_PLACES, FreeMany, Outcome, walked
from doojax.planning.joint_shortcut import JointPath, shortened, way
from doojax.planning.joint_sweep import Sweep, sweep, swept
from doojax.planning.joint_tree import JointSearch, Lengths, MotionQuery, begun, grown
from doojax.robots import Robot, are_free, clearance, travel
from doojax.types import Obstacles

ON_CPU, ON_ACCELERATORS = 4, 64  # more keep a CPU busy with nothing while the last ones are searched
FARTHEST = float(np.deg2rad(280))  # that the thesis lets a joint move from where it starts, rad


@dataclass(frozen=True)
class MotionSettings:
    """How motions are searched for."""

    checks: int = 16_000  # joint positions that a search asks about, at most
    nodes: int = 512  # of each tree, at most
    longest: float = 2.0  # rad, that a joint moves on one line of the search
    step: float = 0.06  # rad, that a joint moves between two places of it
    margin: float = 0.005  # m, to be kept from all that must not be touched
    farthest: float = FARTHEST  # rad, that a joint may move from where it starts
    waypoints: int = 64  # of a motion, at most
    shortcuts: int = 8  # that are tried
    lanes: int | None = None  # queries that are searched at once; by default `ON_CPU` or `ON_ACCELERATORS`
    at_once: int = 4  # places of each line that are asked about before it goes on

    def __post_init__(self):
        """Refuse what finds nothing."""
        for name, value in vars(self).items():
            if value is None:
                continue
            least = 0 if name in ("margin", "shortcuts") else 2 if name in ("nodes", "waypoints") else None
            if not (value > 0 if least is None else value >= least) or value > 1e6:
                wanted = "more than 0" if least is None else f"{least} or more"
                raise ValueError(f"{name} is {value}, expected {wanted}, and at most a million")
        if self.longest > self.step * MOST_PLACES:
            raise ValueError(
                f"longest is {self.longest} rad, expected at most {MOST_PLACES} times step, {self.step} rad"
            )


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

    def free(self, starts: Float[Array, "Q J"]) -> FreeMany:
        """Whether joints that move are free, while the others stay as in a query's start.

        With a margin for each capsule, that is its slack.
        """
        index = np.array(self.moving)

        def many(
            values: Float[Array, "N M"], query: Int[Array, "N"], margin: Float[Array, "N *s"]
        ) -> Bool[Array, "N"]:
            joints = starts[query].at[:, index].set(values)
            keeps, slack = (margin, None) if margin.ndim == 1 else (0.0, margin)
            return are_free(self.robot, joints, self.obstacles, keeps, self.floor, slack)

        return many

    def travels(self, points: Float[Array, "W M"]) -> Float[Array, "W-1 S"]:
        """How far each capsule of the robot moves at most from one point to the next, m."""
        change = jnp.zeros((len(points) - 1, len(self.robot.joints)), points.dtype)
        return travel(self.robot, change.at[:, np.array(self.moving)].set(points[1:] - points[:-1]))

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
    free, lengths = planner.free(starts), Lengths(settings.longest, settings.step)
    at_once, lanes = settings.at_once, settings.lanes
    if lanes is None:
        lanes = ON_CPU if jax.default_backend() == "cpu" else ON_ACCELERATORS

    def begin(query: MotionQuery, key: Array) -> JointSearch:
        return begun(query, lengths, settings.nodes, settings.checks, settings.margin, key)

    def search(own: JointSearch, outcome: Outcome, number: Array) -> JointSearch:
        query = jax.tree.map(lambda leaf: leaf[number], queries)
        return grown(query, own, outcome, lengths, keys[number])

    def shorten(own: JointPath, outcome: Outcome, number: Array) -> JointPath:
        return shortened(own, outcome, settings.step, keys[number])

    searches = walked(jax.vmap(begin)(queries, keys), free, search, lanes, at_once, least=1)
    searches = walked(searches, free, search, 1, at_once)  # hopeless, perhaps: idle lanes would cost as much
    ways = jax.vmap(
        lambda own, key: way(own, settings.waypoints, settings.shortcuts, settings.margin, settings.step, key)
    )(searches, keys)
    paths = walked(ways, free, shorten, lanes, at_once)
    sweeps = jax.vmap(sweep)(paths.points, paths.count, jax.vmap(planner.travels)(paths.points), paths.whole)
    sweeps = walked(sweeps, free, lambda own, outcome, _: swept(own, outcome, at_once), lanes, at_once)
    return jax.vmap(partial(_timed, planner))(sweeps, searches.checks, starts)


def _timed(
    planner: MotionPlanner, way: Sweep, checks: Int[Array, ""], start: Float[Array, "J"]
) -> MotionPlan:
    """A motion along a way that is free, or else none from the start."""
    moving, settings = np.array(planner.moving), planner.settings
    points = jnp.where(way.free, way.points, start[moving])
    every = jnp.broadcast_to(start, (settings.waypoints, len(start))).at[:, moving].set(points)
    longest = (jnp.abs(points[1:] - points[:-1]) / planner.robot.speed[moving]).max(-1)
    times = jnp.concatenate([jnp.zeros(1, longest.dtype), jnp.cumsum(longest)])
    return MotionPlan(every, jnp.where(way.free, way.count, 1), times, way.free, checks)


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
