"""How far a robot is from obstacles, the floor and itself: exact distances of its capsules."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.frames import rotate
from doojax.geometry.segment_sdf import segment_is_far, segment_signed_distance
from doojax.geometry.segments import segment_distance
from doojax.geometry.shapes import FAR
from doojax.robots.kinematics import link_poses
from doojax.robots.robot import Robot
from doojax.types import Obstacles


def capsule_ends(robot: Robot, joints: Float[Array, "J"]) -> Float[Array, "2 S 3"]:
    """Where the axes of the robot's capsules begin and end, in the base's frame, metres."""
    positions, quaternions = link_poses(robot, joints)
    links = np.array(robot.capsule_links, int)
    return positions[links] + rotate(quaternions[links][None], robot.capsule_ends)


def obstacle_distances(robot: Robot, joints: Float[Array, "J"], obstacles: Obstacles) -> Float[Array, "S"]:
    """Distance of each capsule to the nearest obstacle (in the base's frame), metres, negative inside.

    Inside it is how far the capsule's deepest ball would have to move; `doojax.geometry.FAR` or so where no
    obstacle is active.
    """
    start, end = capsule_ends(robot, joints)
    return segment_signed_distance(obstacles, start, end) - robot.capsule_radius


def floor_distances(robot: Robot, joints: Float[Array, "J"], height: float = 0.0) -> Float[Array, "S"]:
    """Distance of each capsule to a floor at ``height`` (m, base's frame), negative below it."""
    return capsule_ends(robot, joints)[..., 2].min(0) - height - robot.capsule_radius


def self_distance(robot: Robot, joints: Float[Array, "J"]) -> Float[Array, ""]:
    """Least distance between two parts of the robot that must not touch, metres.

    Those are `Robot.pairs`, and all of a link but the first with what of the robot does not move. Negative
    where capsules overlap; two whose axes cross give minus the sum of their radii.
    """
    least = [jnp.asarray(FAR, joints.dtype)]
    if robot.pairs:
        least.append(capsule_distances(robot, joints, robot.pairs).min())
    carried = np.array([robot.parents[link] >= 0 for link in robot.capsule_links], bool)
    if carried.any() and robot.base.kind.size:
        least.append(obstacle_distances(robot, joints, robot.base)[np.flatnonzero(carried)].min())
    return jnp.min(jnp.stack(least))


def clearance(
    robot: Robot, joints: Float[Array, "J"], obstacles: Obstacles, floor: float | None = None
) -> Float[Array, ""]:
    """Least distance of the robot to obstacles, to itself and, if there is one, to the floor, metres."""
    least = jnp.minimum(obstacle_distances(robot, joints, obstacles).min(), self_distance(robot, joints))
    return least if floor is None else jnp.minimum(least, floor_distances(robot, joints, floor).min())


def is_free(
    robot: Robot,
    joints: Float[Array, "J"],
    obstacles: Obstacles,
    margin: float | Float[Array, ""] = 0.0,
    floor: float | None = None,
) -> Bool[Array, ""]:
    """Whether `clearance` is more than ``margin`` (m), in less time; True only where that is certain.

    False may be said where up to 1/256 of a capsule's length is missing.
    """
    start, end = capsule_ends(robot, joints)
    least = robot.capsule_radius + margin
    free = segment_is_far(obstacles, start, end, least).all()
    carried = np.flatnonzero([robot.parents[link] >= 0 for link in robot.capsule_links])
    free &= segment_is_far(robot.base, start[carried], end[carried], least[carried]).all()
    if robot.pairs:
        first, second = np.array(robot.pairs).T
        apart = segment_distance(start[first], end[first], start[second], end[second])
        free &= (apart > least[first] + robot.capsule_radius[second]).all()
    if floor is not None:
        free &= (floor_distances(robot, joints, floor) > margin).all()
    return free


def capsule_distances(
    robot: Robot, joints: Float[Array, "J"], pairs: Sequence[tuple[int, int]]
) -> Float[Array, "P"]:
    """Distance between the capsules of each pair, metres, negative where they overlap."""
    if not pairs:
        return jnp.zeros(0, joints.dtype)
    first, second = np.array(pairs).T
    start, end = capsule_ends(robot, joints)
    apart = segment_distance(start[first], end[first], start[second], end[second])
    return apart - robot.capsule_radius[first] - robot.capsule_radius[second]


def travel(robot: Robot, change: Float[Array, "*b J"]) -> Float[Array, "*b S"]:
    """How far any point of each capsule moves at most while joints change straight by so much, m.

    A hinge moves what it carries by its angle times the distance from it, which is at most the sum of all
    offsets from there on; a slide by its own length. Infinite where a slide without limits is in between.
    """
    index = range(len(robot.joints))
    chains = [robot.chain(link) for link in robot.capsule_links]
    carries = np.array([[joint in chain for joint in index] for chain in chains])
    beyond = np.array(
        [
            [[k in chain and joint in chain[: chain.index(k)] for k in index] for joint in index]
            for chain in chains
        ]
    )
    slides = np.array(robot.slides, bool)
    room = jnp.maximum(jnp.abs(robot.low - robot.zero), jnp.abs(robot.high - robot.zero))
    offsets = jnp.linalg.norm(robot.offset, axis=-1) + jnp.where(slides, room, 0)
    own = jnp.linalg.norm(robot.capsule_ends, axis=-1).max(0)
    levers = own[:, None] + jnp.where(beyond, offsets, 0).sum(-1)
    levers = jnp.where(carries, jnp.where(slides, 1, levers), 0)
    moved = jnp.abs(change)[..., None, :]
    return jnp.where(moved > 0, levers * moved, 0).sum(-1)
