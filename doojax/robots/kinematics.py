"""Forward kinematics and Jacobians: where links and tools are, and how joints move them.

All ways from the base to its last links are walked at once, a joint a step: a loop with a small body, which
compiles soon, and in which each number has an array of its own over those ways. A batch (`jax.vmap`) makes
them long, and a CPU computes several at once; no factor is rounded as GPUs round those of matrix products.
What ways share is computed for each of them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from doojax.robots.robot import BASE, Robot

type Numbers = tuple[Array, ...]


class Frames(NamedTuple):
    """Of the links that were asked for, in the base's frame; each number is an array over them."""

    position: Numbers  # x, y, z
    quaternion: Numbers  # w, x, y, z
    axis: Numbers  # of their joints


def tool_poses(robot: Robot, joints: Float[Array, "J"]) -> tuple[Float[Array, "T 3"], Float[Array, "T 4"]]:
    """Positions (m) and unit quaternions of the tools in the base's frame."""
    place, quaternion = tool_frames(robot, frames(robot, joints, robot.tool_links), range(len(robot.tools)))
    return jnp.stack(place, axis=-1), jnp.stack(quaternion, axis=-1)


def link_poses(robot: Robot, joints: Float[Array, "J"]) -> tuple[Float[Array, "J 3"], Float[Array, "J 4"]]:
    """Positions (m) and unit quaternions of all links' frames in the base's frame."""
    links = frames(robot, joints, range(len(robot.joints)))
    return jnp.stack(links.position, axis=-1), jnp.stack(links.quaternion, axis=-1)


def tool_jacobians(robot: Robot, joints: Float[Array, "J"]) -> Float[Array, "T 6 J"]:
    """Velocities of the tools' positions, then their angular velocities, by each joint's; base's axes."""
    rows = []
    for tool, link in enumerate(robot.tool_links):
        chain = robot.chain(link)
        links = frames(robot, joints, chain)
        (x, y, z), _ = tool_frames(robot, last(links), [tool])
        found = jnp.stack(columns(robot, links, chain, (x[0], y[0], z[0])))
        rows.append(jnp.zeros((6, len(robot.joints)), joints.dtype).at[:, np.array(chain, int)].set(found))
    return jnp.stack(rows)


def frames(robot: Robot, joints: Float[Array, "J"], wanted: Sequence[int]) -> Frames:
    """The frames of some links; `BASE` is that of the base."""
    ways = [way for way in map(robot.chain, wanted) if way]
    ways = [way for way in ways if not any(way != other and way == other[: len(way)] for other in ways)]
    ways = list(dict.fromkeys(ways)) or [()]
    depth = max([1, *map(len, ways)])
    # Rows of joints, a step each; beyond a way's end -1, a joint that does nothing.
    steps = np.array([[way[step] if step < len(way) else BASE for way in ways] for step in range(depth)])
    real = steps != BASE
    value = jnp.where(real, joints[steps] - robot.zero[steps], 0)
    offset = jnp.where(real[..., None], robot.offset[steps], 0)
    axis = jnp.where(real[..., None], robot.axis[steps], 0)
    slide = np.where(real, np.array([*robot.slides, False])[steps], False)
    angle, length = jnp.where(slide, 0, value), jnp.where(slide, value, 0)
    sine, cosine = jnp.sin(angle / 2), jnp.cos(angle / 2)
    offset = offset + length[..., None] * axis
    turns = (cosine, *(axis[..., i] * sine for i in range(3)))

    def step(parent: tuple[Numbers, Numbers], link: tuple[Numbers, ...]) -> tuple:
        position, quaternion = parent
        offset, axis, by = link
        place = add(position, turn(quaternion, offset))
        turned = multiply(quaternion, by)
        return (place, turned), (place, turned, turn(quaternion, axis))

    one = jnp.ones_like(value[0])
    begin = (one * 0, one * 0, one * 0), (one, one * 0, one * 0, one * 0)
    parts = tuple(tuple(values[..., i] for i in range(3)) for values in (offset, axis))
    _, found = lax.scan(step, begin, (*parts, turns))
    where = {joint: (row, lane) for row, lanes in enumerate(steps) for lane, joint in enumerate(lanes)}
    rows, lanes = np.array([where.get(link, (0, 0)) for link in wanted], int).reshape(-1, 2).T
    on_base = np.array([link == BASE for link in wanted], bool)
    position, quaternion, axes = (tuple(part[rows, lanes] for part in parts) for parts in found)
    if on_base.any():
        position, axes = (tuple(jnp.where(on_base, 0, part) for part in parts) for parts in (position, axes))
        quaternion = tuple(jnp.where(on_base, float(i == 0), part) for i, part in enumerate(quaternion))
    return Frames(position, quaternion, axes)


def last(links: Frames) -> Frames:
    """The last of some links alone, with an axis of one."""
    return Frames(*(tuple(part[-1:] for part in parts) for parts in links))


def tool_frames(robot: Robot, links: Frames, tools: Sequence[int]) -> tuple[Numbers, Numbers]:
    """Positions and quaternions of tools, given their links' frames."""
    index = np.array(tools, int)
    offset = tuple(robot.tool_position[index, i] for i in range(3))
    by = tuple(robot.tool_quaternion[index, i] for i in range(4))
    return add(links.position, turn(links.quaternion, offset)), multiply(links.quaternion, by)


def columns(robot: Robot, links: Frames, chain: Sequence[int], place: Numbers) -> Numbers:
    """How each joint of a chain moves a point at ``place`` that it carries, and turns it: six numbers."""
    slides = np.array([robot.slides[joint] for joint in chain], bool)
    arm = tuple(there - here for there, here in zip(place, links.position, strict=True))
    moved = cross(links.axis, arm)
    if not slides.any():
        return (*moved, *links.axis)
    moved = tuple(jnp.where(slides, a, b) for a, b in zip(links.axis, moved, strict=True))
    return (*moved, *(jnp.where(slides, 0, part) for part in links.axis))


def add(left: Numbers, right: Numbers) -> Numbers:
    """The sum."""
    return tuple(a + b for a, b in zip(left, right, strict=True))


def cross(left: Numbers, right: Numbers) -> Numbers:
    """The vector product."""
    (a, b, c), (x, y, z) = left, right
    return b * z - c * y, c * x - a * z, a * y - b * x


def turn(quaternion: Numbers, vector: Numbers) -> Numbers:
    """The vector, turned."""
    real, *imaginary = quaternion
    twice = tuple(2 * part for part in cross(tuple(imaginary), vector))
    more = cross(tuple(imaginary), twice)
    return tuple(v + real * a + b for v, a, b in zip(vector, twice, more, strict=True))


def multiply(left: Numbers, right: Numbers) -> Numbers:
    """The rotation that first turns by ``right``, then by ``left``."""
    (a, b, c, d), (w, x, y, z) = left, right
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
