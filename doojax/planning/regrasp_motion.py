"""Motions of one tool to places on a rope, past obstacles: inverse kinematics, then a search in joint space.

The rope is in nobody's way, as in the thesis. The arm that holds it, and the torso, stay where they are; when
nobody holds it while the tool moves, everything may move.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from doojax.keys import numbered
from doojax.planning.joint_motion import MotionPlan, MotionPlanner, MotionSettings, plan_motions
from doojax.robots import IkSettings, Robot, clearance, inverse_kinematics
from doojax.types import Obstacles

IK = IkSettings(starts=24)
GOALS = 4  # solutions of inverse kinematics that a motion may end in
SIDE_BY_SIDE = 4  # motions
SEARCH = MotionSettings(checks=3200, nodes=256, waypoints=48, lanes=SIDE_BY_SIDE)


def free_to_move(robot: Robot, tool: str, moving: tuple[int, ...], *, alone: bool) -> np.ndarray:
    """Which joints may move: of ``moving`` all, or with ``alone`` those of the tool's arm."""
    chains = [set(robot.chain(link)) for link in robot.tool_links]
    own = chains[robot.tool(tool)]
    others = set().union(*(c for i, c in enumerate(chains) if i != robot.tool(tool)))
    chosen = [j for j in moving if not alone or (j in own and j not in others)]
    return np.isin(np.arange(len(robot.joints)), chosen)


def tool_goals(
    robot: Robot,
    tool: str,
    moving: tuple[int, ...],
    obstacles: Obstacles,
    floor: float,
    present: Float[Array, "J"],
    places: Float[Array, "M 3"],
    key: Key[Array, ""],
    *,
    alone: bool,
) -> tuple[Float[Array, "M G J"], Bool[Array, "M G"]]:
    """Joints that bring a tool to each of M places, the nearest first, and which of them are free.

    Args:
        robot: in whose base's frame everything is given, m.
        tool: its name.
        moving: indices of the joints that ever move.
        obstacles: that nothing may touch.
        floor: its height.
        present: joints now.
        places: of the tool.
        key: for starts of the search.
        alone: may only the tool's own arm move?
    """
    held = _held(robot, tool, moving, present, alone)
    keys = numbered(key, range(len(places)))
    return _solutions(held, tool, obstacles, floor, present, places, keys, SEARCH)


def motions_to(
    robot: Robot,
    tool: str,
    moving: tuple[int, ...],
    obstacles: Obstacles,
    floor: float,
    start: Float[Array, "J"],
    goals: Sequence[Float[np.ndarray, "_ J"]],
    key: Key[Array, ""],
    *,
    alone: bool,
    settings: MotionSettings = SEARCH,
) -> MotionPlan:
    """Motions from one free start, each to any of some joints, searched for side by side.

    ``goals`` has at most `GOALS` for each; the other arguments are those of `tool_goals`.
    """
    held = _held(robot, tool, moving, start, alone)
    # what there is none of is out of limits: then it is never met
    ends = np.full((len(goals), GOALS, len(start)), 1e3, np.float32)
    for row, own in enumerate(goals):
        ends[row, : len(own)] = own
    mask = free_to_move(robot, tool, moving, alone=alone)
    ends[..., ~mask] = np.asarray(start)[~mask]  # a start that was moved out of collision moves them all
    planner = MotionPlanner(held, obstacles, moving, floor, settings)
    return plan_motions(planner, jnp.broadcast_to(start, (len(goals), len(start))), jnp.asarray(ends), key)


def _held(robot: Robot, tool: str, moving: tuple[int, ...], at: Float[Array, "J"], alone: bool) -> Robot:
    """The robot whose limits keep all joints but those that may move where they are."""
    mask = jnp.asarray(free_to_move(robot, tool, moving, alone=alone))
    limits = jnp.where(mask, robot.low, at), jnp.where(mask, robot.high, at)
    return eqx.tree_at(lambda r: (r.low, r.high), robot, limits)


@eqx.filter_jit
def _solutions(
    robot: Robot,
    tool: str,
    obstacles: Obstacles,
    floor: float,
    present: Float[Array, "J"],
    places: Float[Array, "M 3"],
    keys: Key[Array, "M"],
    settings: MotionSettings,
) -> tuple[Float[Array, "M G J"], Bool[Array, "M G"]]:
    """Of each place the free solutions that are nearest to the present joints."""
    clear = partial(clearance, robot, obstacles=obstacles, floor=floor)

    def one(place: Array, key: Array) -> tuple[Array, Array]:
        found = inverse_kinematics(robot, tool, place, present, key, settings=IK)
        near = jnp.abs(found.joints - present).max(-1) < settings.farthest
        free = jax.lax.map(lambda joints: clear(joints), found.joints, batch_size=12) > settings.margin + 1e-4
        good = found.solved & near & free
        order = jnp.argsort(~good, stable=True)[:GOALS]
        return found.joints[order], good[order]

    return jax.lax.map(lambda query: one(*query), (places, keys), batch_size=4)
