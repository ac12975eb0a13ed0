"""Inverse kinematics of many poses: more starts for those that the present joints do not lead to."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from doojax.parts import in_parts, worth_parts
from doojax.robots.inverse import IkSettings, IkSolutions, inverse_kinematics
from doojax.robots.robot import Robot

PART = 256  # searches at once: enough to hide what each operation costs, few enough for a core's cache
SETTINGS = IkSettings(starts=16)


def solve_poses(
    robot: Robot,
    tool: str,
    positions: Float[Array, "M 3"],
    present: Float[Array, "J"],
    key: Key[Array, ""],
    quaternions: Float[Array, "M 4"] | None = None,
    settings: IkSettings = SETTINGS,
) -> IkSolutions:
    """For each pose the joints that the present ones lead to, or else the best of ``settings.starts``.

    Outside of jit, since how many need more starts differs; inside, map `inverse_kinematics`. Arguments,
    errors and results as there, but with an axis of poses first and one solution of each. It is compiled once
    for each robot object, whose numbers are constants of it: read a robot once.
    """
    robot.tool(tool)
    first = replace(settings, starts=1)
    first_keys, more_keys = jax.random.split(key)
    found = _solved(robot, tool, positions, present, first_keys, quaternions, first, PART)
    (left,) = np.nonzero(~np.asarray(found.solved[:, 0]))
    if not left.size or settings.starts == 1:
        return found
    size = -(-2 * PART // settings.starts)
    rows = np.resize(left, -(-left.size // size) * size)  # whole parts, so that there is one shape
    turns = None if quaternions is None else quaternions[rows]
    more = _solved(robot, tool, positions[rows], present, more_keys, turns, settings, size)
    return jax.tree.map(lambda old, new: old.at[left].set(new[: left.size]), found, more)


def _solved(
    robot: Robot,
    tool: str,
    positions: Float[Array, "M 3"],
    present: Float[Array, "J"],
    key: Key[Array, ""],
    quaternions: Float[Array, "M 4"] | None,
    settings: IkSettings,
    size: int,
) -> IkSolutions:
    """The best solution of each pose, with an axis of one for it."""
    keys = jax.random.split(key, len(positions))
    solve = partial(_best, tool, settings, robot, jnp.asarray(present))
    batch = (positions, keys) if quaternions is None else (positions, keys, quaternions)
    if len(positions) > size and worth_parts(size, batch, robot, present):
        return in_parts(solve, size, *batch)
    return solve(*batch)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _best(
    tool: str, settings: IkSettings, robot: Robot, present: Float[Array, "J"], *poses: Array
) -> IkSolutions:
    def one(position: Array, key: Array, quaternion: Array | None = None) -> IkSolutions:
        found = inverse_kinematics(robot, tool, position, present, key, quaternion, settings)
        return jax.tree.map(lambda leaf: leaf[:1], found)

    return jax.vmap(one)(*poses)
