"""Inverse kinematics: joints that bring a tool to a place, by damped least squares from many starts."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Key

from doojax.parts import traced
from doojax.robots.kinematics import Numbers, columns, frames, last, multiply, tool_frames
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

    def check(self) -> None:
        """Raise ValueError, with how near the tool comes, if a place is not reached; outside of jit."""
        reached = np.asarray(self.solved[..., 0]).ravel()
        if reached.all():
            return
        off, angle = (np.asarray(values[..., 0]).ravel()[~reached] for values in (self.error, self.angle))
        raise ValueError(
            f"{(~reached).sum()} of {reached.size} poses are not reached: of the first the tool stays "
            f"{off[0]:.3g} m and {angle[0]:.3g} rad off. Ask for a place nearer to the robot, for no "
            "orientation, or try more starts"
        )


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
    starts = starts_around(robot, chain, present, key, settings.starts)

    def search(start: Float[Array, "C"]) -> tuple[Array, Array, Array]:
        def improve(_: Array, now: tuple[Array, Array, Numbers]) -> tuple[Array, Array, Numbers]:
            joints = now[0]
            error, moves = _residual(
                robot, index, chain, present.at[chain].set(joints), position, quaternion, settings
            )
            square = sum((part * part for part in error), jnp.asarray(settings.damping, start.dtype))
            step = _damped_step(moves, error, square)
            better = jnp.clip(joints + jnp.clip(step, -settings.longest, settings.longest), low, high)
            return better, joints, error

        nothing = tuple(jnp.zeros_like(start[0]) for _ in range(3 if quaternion is None else 6))
        _, joints, error = lax.fori_loop(0, settings.iterations + 1, improve, (start, start, nothing))
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


def starts_around(
    robot: Robot, chain: np.ndarray, present: Float[Array, "J"], key: Key[Array, ""], count: int
) -> Float[Array, "N C"]:
    """The present joints of a chain, and others within the limits and half a turn of them."""
    begin = present[chain]
    low, high = (jnp.clip(limit[chain], begin - jnp.pi, begin + jnp.pi) for limit in (robot.low, robot.high))
    return jax.random.uniform(key, (count, len(chain)), present.dtype, low, high).at[0].set(begin)


def _residual(
    robot: Robot,
    tool: int,
    chain: np.ndarray,
    joints: Float[Array, "J"],
    position: Float[Array, "3"],
    quaternion: Float[Array, "4"] | None,
    settings: IkSettings,
) -> tuple[Numbers, Numbers]:
    """What is missing, three or six numbers in metres, and how the joints of the chain change each."""
    links = frames(robot, joints, chain.tolist())
    place, turn = (tuple(part[0] for part in parts) for parts in tool_frames(robot, last(links), [tool]))
    error = tuple(there - here for there, here in zip(tuple(position), place, strict=True))
    moves = columns(robot, links, chain.tolist(), place)
    if quaternion is None:
        return error, moves[:3]
    real, *imaginary = multiply(tuple(quaternion), (turn[0], -turn[1], -turn[2], -turn[3]))
    sine = jnp.sqrt(sum(part * part for part in imaginary))
    angle = 2 * jnp.arctan2(sine, jnp.abs(real)) * jnp.sign(jnp.where(real == 0, 1, real))
    weight = settings.angle_weight
    scale = weight * jnp.where(sine > 1e-6, angle / jnp.maximum(sine, 1e-6), 2 * jnp.sign(real))
    turning = tuple(weight * part for part in moves[3:])
    return (*error, *(scale * part for part in imaginary)), (*moves[:3], *turning)


def _damped_step(moves: Numbers, error: Numbers, damping: Array) -> Float[Array, "C"]:
    """J^T (J J^T + damping)^-1 error, by Cholesky's decomposition, number by number."""
    once, size = (
        lax.optimization_barrier,
        range(len(error)),
    )  # else XLA computes it anew for each number of it
    rows: list[list[Array]] = []
    for i in size:
        row: list[Array] = []
        for j in range(i + 1):
            value = (moves[i] * moves[j]).sum() + (damping if i == j else 0)
            value = value - sum(row[k] * other for k, other in enumerate(rows[j][:j] if j < i else row))
            row.append(value / rows[j][j] if j < i else jnp.sqrt(jnp.maximum(value, 1e-12)))
        rows.append(once(row))
    forward: list[Array] = []
    for i in size:
        forward.append(once((error[i] - sum(rows[i][k] * forward[k] for k in range(i))) / rows[i][i]))
    solved: dict[int, Array] = {}
    for i in reversed(size):
        above = sum(rows[k][i] * solved[k] for k in range(i + 1, len(error)))
        solved[i] = once((forward[i] - above) / rows[i][i])
    return sum((moves[i] * solved[i] for i in size), jnp.zeros_like(moves[0]))


def _check_limits(robot: Robot, present: Float[Array, "J"]) -> None:
    joint = robot.beyond_limits(present)
    if joint is not None:
        raise ValueError(
            f"joint {robot.joints[joint]!r} is at {float(present[joint]):.6g}, expected within its limits, "
            f"{float(robot.low[joint]):.6g} to {float(robot.high[joint]):.6g}"
        )
