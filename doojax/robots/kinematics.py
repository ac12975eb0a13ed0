"""Forward kinematics and Jacobians: where links and tools are, and how joints move them.

Everything is written number by number along the tree. A batch (`jax.vmap`) makes long arrays of them, which a
CPU computes several at once, and no factor is rounded as GPUs round those of matrix products.
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.robots.robot import BASE, Robot

type Numbers = tuple[Array, ...]


class Frame(NamedTuple):
    """A link in the base's frame."""

    position: Numbers  # x, y, z
    quaternion: Numbers  # w, x, y, z
    axis: Numbers  # of its joint


def tool_poses(robot: Robot, joints: Float[Array, "J"]) -> tuple[Float[Array, "T 3"], Float[Array, "T 4"]]:
    """Positions (m) and unit quaternions of the tools in the base's frame."""
    links = frames(robot, joints, robot.tool_links)
    found = [tool_frame(robot, links, tool) for tool in range(len(robot.tools))]
    return jnp.stack([jnp.stack(place) for place, _ in found]), jnp.stack(
        [jnp.stack(turn) for _, turn in found]
    )


def link_poses(robot: Robot, joints: Float[Array, "J"]) -> tuple[Float[Array, "J 3"], Float[Array, "J 4"]]:
    """Positions (m) and unit quaternions of all links' frames in the base's frame."""
    links = frames(robot, joints, range(len(robot.joints)))
    found = [links[joint] for joint in range(len(robot.joints))]
    return (
        jnp.stack([jnp.stack(frame.position) for frame in found]),
        jnp.stack([jnp.stack(frame.quaternion) for frame in found]),
    )


def tool_jacobians(robot: Robot, joints: Float[Array, "J"]) -> Float[Array, "T 6 J"]:
    """Velocities of the tools' positions, then their angular velocities, by each joint's; base's axes."""
    links = frames(robot, joints, robot.tool_links)
    still = [jnp.zeros_like(joints[0])] * 6
    rows = []
    for tool, link in enumerate(robot.tool_links):
        place, _ = tool_frame(robot, links, tool)
        chain = robot.chain(link)
        columns = {joint: column(robot, links[joint], joint, place) for joint in chain}
        rows.append(jnp.stack([jnp.stack(columns.get(j, still)) for j in range(len(robot.joints))], axis=-1))
    return jnp.stack(rows)


def frames(robot: Robot, joints: Float[Array, "J"], wanted: Iterable[int]) -> dict[int, Frame]:
    """The frames of some links and of all that carry them, and that of the base."""
    one, zero = jnp.ones_like(joints[0]), jnp.zeros_like(joints[0])
    found = {BASE: Frame((zero, zero, zero), (one, zero, zero, zero), (zero, zero, zero))}
    for joint in sorted({joint for link in wanted for joint in robot.chain(link)}):
        parent = found[robot.parents[joint]]
        value = joints[joint] - robot.zero[joint]
        x, y, z = axis = tuple(robot.axis[joint])
        offset = tuple(robot.offset[joint])
        if robot.slides[joint]:
            offset = tuple(a + value * b for a, b in zip(offset, axis, strict=True))
            quaternion = parent.quaternion
        else:
            sine = jnp.sin(value / 2)
            quaternion = multiply(parent.quaternion, (jnp.cos(value / 2), x * sine, y * sine, z * sine))
        found[joint] = Frame(
            add(parent.position, turn(parent.quaternion, offset)), quaternion, turn(parent.quaternion, axis)
        )
    return found


def tool_frame(robot: Robot, links: dict[int, Frame], tool: int) -> tuple[Numbers, Numbers]:
    """Position and quaternion of a tool."""
    link = links[robot.tool_links[tool]]
    place = add(link.position, turn(link.quaternion, tuple(robot.tool_position[tool])))
    return place, multiply(link.quaternion, tuple(robot.tool_quaternion[tool]))


def column(robot: Robot, link: Frame, joint: int, place: Numbers) -> Numbers:
    """How a joint moves a point at ``place`` that it carries, and turns it."""
    if robot.slides[joint]:
        zero = jnp.zeros_like(place[0])
        return (*link.axis, zero, zero, zero)
    arm = tuple(a - b for a, b in zip(place, link.position, strict=True))
    return (*cross(link.axis, arm), *link.axis)


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
