"""Displacements of tools: joints that take them there straight, as far as nothing is in the way."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.frames import exact_product
from doojax.robots.clearance import is_free
from doojax.robots.kinematics import tool_jacobians, tool_poses
from doojax.robots.robot import Robot
from doojax.types import Obstacles

STEP = 0.02  # m, of a tool between two postures that are checked
ITERATIONS = 4  # of each such step
DAMPING, DAMPED = 1e-5, 0.1  # m^2, and of the squared error: careful far away
LONGEST = 0.3  # rad, of a joint in one iteration
TOLERANCE = 2e-3  # m, that a tool may be off its straight way


class Displaced(eqx.Module):
    """Where displacements led."""

    joints: Float[Array, "*b J"]
    part: Float[Array, "*b"]  # of the way: 1 if all of it was possible
    joints_on_the_way: Float[Array, "*b K J"]


def displaced(
    robot: Robot,
    joints: Float[Array, "J"],
    moves: Float[Array, "T 3"],
    obstacles: Obstacles,
    moving: tuple[int, ...],
    margin: float = 0.005,
    floor: float | None = None,
    longest: float = 0.1,
) -> Displaced:
    """Joints that move every tool by its displacement, all at once and along straight lines.

    Where joints at their limits, or the arms' reach, let a tool lag by more than 2 mm, or something would be
    nearer than ``margin``, they stop at the posture before: all tools, at the same part of their ways. A
    start that is not free, or beyond limits, stays as it is.

    Args:
        robot: any with tools.
        joints: now.
        moves: of the tools, base's axes, m; those longer than ``longest`` are shortened.
        obstacles: base's frame.
        moving: indices of joints that may move.
        margin: to keep from everything that must not be touched, m.
        floor: its height, m.
        longest: of a displacement, m.
    """
    count = max(1, int(np.ceil(longest / STEP)))
    length = jnp.linalg.norm(moves, axis=-1, keepdims=True)
    moves = moves * jnp.minimum(1, longest / jnp.maximum(length, 1e-9))
    begin = tool_poses(robot, joints)[0]
    fits = partial(is_free, robot, obstacles=obstacles, margin=margin, floor=floor)

    def step(
        now: tuple[Array, Bool[Array, ""]], part: Array
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        at, goes = now
        target = begin + part * moves
        there, off = tools_towards(robot, at, target, moving, ITERATIONS)
        goes &= (off <= TOLERANCE) & fits(there)
        at = jnp.where(goes, there, at)
        return (at, goes), (at, jnp.where(goes, part, 0.0))

    inside = ((joints >= robot.low - 1e-5) & (joints <= robot.high + 1e-5)).all()
    parts = jnp.arange(1, count + 1, dtype=joints.dtype) / count
    (after, _), (way, done) = jax.lax.scan(step, (joints, inside & fits(joints)), parts)
    return Displaced(after, done.max(), way)


def tools_towards(
    robot: Robot,
    joints: Float[Array, "J"],
    places: Float[Array, "T 3"],
    moving: tuple[int, ...],
    iterations: int,
) -> tuple[Float[Array, "J"], Float[Array, ""]]:
    """Joints within limits that bring all tools nearer to their places, and how far one is still off.

    Damped least squares for all tools together, since they may share joints; from ``joints`` alone.
    """
    index = np.array(moving)

    def improve(_: Array, now: Float[Array, "J"]) -> Float[Array, "J"]:
        error = (places - tool_poses(robot, now)[0]).ravel()
        jacobian = tool_jacobians(robot, now)[:, :3, index].reshape(-1, len(index))
        damping = DAMPING + DAMPED * (error**2).sum()
        square = exact_product(jacobian, jacobian.T) + damping * jnp.eye(len(error), dtype=now.dtype)
        change = exact_product(jacobian.T, jnp.linalg.solve(square, error[:, None]))[:, 0]
        return jnp.clip(now.at[index].add(jnp.clip(change, -LONGEST, LONGEST)), robot.low, robot.high)

    after = jax.lax.fori_loop(0, iterations, improve, joints)
    return after, jnp.linalg.norm(tool_poses(robot, after)[0] - places, axis=-1).max()


def velocities(
    robot: Robot, joints: Float[Array, "J"], after: Float[Array, "J"], duration: float
) -> Float[Array, "J"]:
    """Velocities, of all joints, that lead from some to others in ``duration`` (s).

    Where one would be faster than it can, all are as much slower: they go the same way, but not as far.
    """
    wanted = (after - joints) / duration
    most = jnp.where(jnp.abs(wanted) > 0, robot.speed / jnp.maximum(jnp.abs(wanted), 1e-9), jnp.inf)
    return wanted * jnp.minimum(1, most.min())
