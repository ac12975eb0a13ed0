"""Inverse kinematics: joints that bring a tool to a place, by damped least squares from many starts."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from doojax.parts import traced
from doojax.robots.kinematics import Numbers, column, frames, multiply, tool_frame
from doojax.robots.robot import Robot

MOST = {"starts": 100_000, "iterations": 10_000}


@dataclass(frozen=True)
class IkSettings:
    """How solutions are looked for."""

    starts: int = 8  # the present joints, and others drawn within the limits
    iterations: int = 30
    damping: float = 1e-4  # m^2, added to the squared error that damps each step
    longest: float = 0.6  # rad or m, of one joint in one step
    tolerance: float = 1e-3  # m, within which a place counts as reached
    angle_tolerance: float = 1e-2  # rad
    angle_weight: float = 0.3  # m for each radian

    def __post_init__(self):
        """Refuse what finds nothing."""
        for name, value in vars(self).items():
            most = MOST.get(name, float("inf"))
            least = 1 if name in MOST else 0
            if not (least <= value <= most and value > 0):
                raise ValueError(
                    f"{name} is {value}, expected {f'1 to {most:,}' if least else 'more than 0'}"
                )


class IkSolutions(eqx.Module):
    """What N starts led to: first those that solve, the nearest to the present joints before others."""

    joints: Float[Array, "*b N J"]
    error: Float[Array, "*b N"]  # m, that the tool is off
    angle: Float[Array, "*b N"]  # rad, that it is turned off; zero where no orientation was asked for
    travel: Float[Array, "*b N"]  # from the present joints, the root of the sum of squares
    solved: Bool[Array, "*b N"]  # within the tolerances. An unreachable place is one that none solves


def inverse_kinematics(
    robot: Robot,
    tool: str,
    position: Float[Array, "3"],
    present: Float[Array, "J"],
    key: Key[Array, ""],
    quaternion: Float[Array, "4"] | None = None,
    settings: IkSettings = IkSettings(),
) -> IkSolutions:
    """Joints within the limits that bring a tool to a place; those that do not carry it stay as they are.

    One step of damped least squares is J^T (J J^T + d)^-1 e, with d the squared error and a little more
    (Sugihara 2011), so that it is careful far away and quick near by. Joints at a limit stay within it.

    Args:
        robot: any.
        tool: its name.
        position: of the tool, in the base's frame, metres.
        present: joints to begin with and to stay near to; inside of jit they are moved within the limits.
        key: for other starts.
        quaternion: the tool's orientation, unit; any if none is given.
        settings: of the search.

    Raises:
        ValueError: for an unknown tool, or, outside of jit, for joints beyond the limits.
    """
    index = robot.tool(tool)
    chain = np.array(robot.chain(robot.tool_links[index]), int)
    if not traced(present, robot):
        _check_limits(robot, present)
    low, high = robot.low[chain], robot.high[chain]
    present = jnp.clip(present, robot.low, robot.high)
    begin = present[chain]
    least, most = (jnp.clip(limit, begin - jnp.pi, begin + jnp.pi) for limit in (low, high))
    drawn = jax.random.uniform(key, (settings.starts, len(chain)), present.dtype, least, most)
    starts = drawn.at[0].set(begin)

    def search(start: Float[Array, "C"]) -> tuple[Array, Array, Array]:
        def improve(_: Array, joints: Float[Array, "C"]) -> Float[Array, "C"]:
            error, columns = residual(joints)
            square = sum((part * part for part in error), jnp.asarray(settings.damping, joints.dtype))
            step = _damped_step(columns, error, square)
            return jnp.clip(joints + jnp.clip(step, -settings.longest, settings.longest), low, high)

        def residual(joints: Float[Array, "C"]) -> tuple[Numbers, list[Numbers]]:
            return _residual(
                robot, index, chain, present.at[chain].set(joints), position, quaternion, settings
            )

        joints = jax.lax.fori_loop(0, settings.iterations, improve, start)
        error, _ = residual(joints)
        off = jnp.sqrt(sum(part * part for part in error[:3]))
        turned = jnp.sqrt(sum(part * part for part in error[3:])) if error[3:] else jnp.zeros_like(off)
        return joints, off, turned / settings.angle_weight

    joints, off, turned = jax.vmap(search)(starts)
    solved = (off <= settings.tolerance) & (turned <= settings.angle_tolerance)
    travel = jnp.sqrt(((joints - begin) ** 2).sum(-1))
    missing = off + settings.angle_weight * turned
    order = jnp.lexsort((jnp.where(solved, travel, missing), ~solved))
    whole = jnp.broadcast_to(present, (settings.starts, len(present))).at[:, chain].set(joints)
    return jax.tree.map(lambda leaf: leaf[order], IkSolutions(whole, off, turned, travel, solved))


def _residual(
    robot: Robot,
    tool: int,
    chain: np.ndarray,
    joints: Float[Array, "J"],
    position: Float[Array, "3"],
    quaternion: Float[Array, "4"] | None,
    settings: IkSettings,
) -> tuple[Numbers, list[Numbers]]:
    """What is missing, three or six numbers in metres, and how each joint of the chain changes it."""
    links = frames(robot, joints, (robot.tool_links[tool],))
    place, turn = tool_frame(robot, links, tool)
    error = tuple(there - here for there, here in zip(tuple(position), place, strict=True))
    columns = [column(robot, links[joint], joint, place) for joint in chain.tolist()]
    if quaternion is None:
        return error, [one[:3] for one in columns]
    real, *imaginary = multiply(tuple(quaternion), (turn[0], -turn[1], -turn[2], -turn[3]))
    sine = jnp.sqrt(sum(part * part for part in imaginary))
    angle = 2 * jnp.arctan2(sine, jnp.abs(real)) * jnp.sign(jnp.where(real == 0, 1, real))
    scale = settings.angle_weight * jnp.where(
        sine > 1e-6, angle / jnp.maximum(sine, 1e-6), 2 * jnp.sign(real)
    )
    weight = settings.angle_weight
    weighted = [(*one[:3], *(weight * part for part in one[3:])) for one in columns]
    return (*error, *(scale * part for part in imaginary)), weighted


def _damped_step(columns: list[Numbers], error: Numbers, damping: Array) -> Float[Array, "C"]:
    """J^T (J J^T + damping)^-1 error, by Cholesky's decomposition, number by number."""
    size = range(len(error))
    root: dict[tuple[int, int], Array] = {}
    for i in size:
        for j in range(i + 1):
            value = sum((one[i] * one[j] for one in columns), damping if i == j else jnp.zeros_like(damping))
            value = value - sum(root[i, k] * root[j, k] for k in range(j))
            root[i, j] = jnp.sqrt(jnp.maximum(value, 1e-12)) if i == j else value / root[j, j]
    forward: list[Array] = []
    for i in size:
        forward.append((error[i] - sum(root[i, k] * forward[k] for k in range(i))) / root[i, i])
    solved: dict[int, Array] = {}
    for i in reversed(size):
        solved[i] = (forward[i] - sum(root[k, i] * solved[k] for k in range(i + 1, len(error)))) / root[i, i]
    return jnp.stack([sum(one[i] * solved[i] for i in size) for one in columns])


def _check_limits(robot: Robot, present: Float[Array, "J"]) -> None:
    beyond = np.flatnonzero(np.asarray((present < robot.low - 1e-5) | (present > robot.high + 1e-5)))
    if beyond.size:
        joint = int(beyond[0])
        raise ValueError(
            f"joint {robot.joints[joint]!r} is at {float(present[joint]):.6g}, expected within its limits, "
            f"{float(robot.low[joint]):.6g} to {float(robot.high[joint]):.6g}"
        )
