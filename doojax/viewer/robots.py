"""Robots on any `Drawing`: the shapes of links where joints have them, and which of these touch."""

from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.experiments.drawing import Colour, Drawing
from doojax.experiments.trials.records import TrialRecord
from doojax.geometry.frames import quaternion_multiply
from doojax.geometry.shapes import FAR
from doojax.robots import (
    Robot,
    capsule_ends,
    dual_arm,
    floor_distances,
    obstacle_distances,
    tool_poses,
)
from doojax.robots.clearance import capsule_distances
from doojax.robots.robot import BASE as FIXED
from doojax.tasks.arms import BASE
from doojax.types import Obstacles, ShapeKind
from doojax.viewer.episodes import rotation_matrices
from doojax.viewer.shapes import turns_from_z

LINK: Colour = (120, 132, 150)
STAND: Colour = (86, 95, 110)  # what of a robot does not move
TOUCHES: Colour = (200, 40, 30)
AXES = 0.08  # m, of a tool's frame


class Posture(NamedTuple):
    """Where joints have a robot, in its base's frame, m: arrays of JAX, or of numpy once they are fetched."""

    ends: Any  # [2, S, 3] of its capsules' axes
    tools: Any  # [T, 3]
    turns: Any  # [T, 4]
    apart: Any  # [S], each capsule from all that it must not touch

    @property
    def clearance(self) -> float:
        """As `doojax.robots.clearance`, m."""
        return float(np.min(self.apart, initial=FAR))


def posture(robot: Robot, joints: Float[Array, "J"], obstacles: Obstacles, floor: float | None) -> Posture:
    """Where joints have a robot, and how far that is from everything it must not touch; pure."""
    if not robot.capsule_links:
        return Posture(capsule_ends(robot, joints), *tool_poses(robot, joints), jnp.zeros(0))
    apart = obstacle_distances(robot, joints, obstacles)
    if floor is not None:
        apart = jnp.minimum(apart, floor_distances(robot, joints, floor))
    if robot.pairs:
        pairs, between = np.array(robot.pairs), capsule_distances(robot, joints, robot.pairs)
        for side in pairs.T:
            apart = apart.at[side].min(between)
    if robot.base.kind.size:
        carried = np.array([robot.parents[link] != FIXED for link in robot.capsule_links], bool)
        fixed = obstacle_distances(robot, joints, robot.base)
        apart = jnp.minimum(apart, jnp.where(carried, fixed, FAR))
    return Posture(capsule_ends(robot, joints), *tool_poses(robot, joints), apart)


def robot_shapes(robot: Robot, ends: Float[np.ndarray, "2 S 3"]) -> Obstacles:
    """A robot's capsules by the ends of their axes (m), as shapes that can be drawn; in the ends' frame."""
    start, end = np.asarray(ends, np.float64)
    # of the file's numbers, lest rounding makes meshes anew
    length = np.linalg.norm(np.diff(np.asarray(robot.capsule_ends), axis=0)[0], axis=1)
    axis = np.where(
        length[:, None] > 1e-6, (end - start) / np.maximum(length, 1e-6)[:, None], [0.0, 0.0, 1.0]
    )
    radius = np.asarray(robot.capsule_radius)
    return Obstacles(
        kind=jnp.full(len(axis), int(ShapeKind.CAPSULE)),
        centre=jnp.asarray((start + end) / 2),
        quaternion=jnp.asarray(turns_from_z(axis)),
        half_size=jnp.asarray(np.stack([radius, radius, length / 2], axis=1)),
        active=jnp.ones(len(axis), bool),
    )


def placed_at(
    places: Float[np.ndarray, "*k 3"], base: tuple[float, float, float], yaw: float
) -> Float[np.ndarray, "*k 3"]:
    """Places in the frame of a base, m, in the world, in which it is at ``base`` and turned by ``yaw``."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return places @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) + np.array(base)


def box_of(shapes: Obstacles) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest x, y and z of some shapes, m; a cylinder's is that of the box around it."""
    turns = np.abs(rotation_matrices(np.asarray(shapes.quaternion)))
    half, capsule = np.asarray(shapes.half_size), np.asarray(shapes.kind) == ShapeKind.CAPSULE
    along = turns[:, :, 2] * half[:, 2:] + half[:, :1]
    reach = np.where(capsule[:, None], along, np.einsum("kij,kj->ki", turns, half))
    centre = np.asarray(shapes.centre)
    return np.stack([(centre - reach).min(0), (centre + reach).max(0)])


def show_robot(
    drawing: Drawing,
    name: str,
    robot: Robot,
    ends: Float[np.ndarray, "2 S 3"],
    *,
    base: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw: float = 0.0,
    touching: Bool[np.ndarray, "S"] | None = None,
    colour: Colour = LINK,
    opacity: float = 1.0,
) -> None:
    """A robot by the ends of its capsules' axes.

    Args:
        drawing: where to.
        name: of the robot; ``name/stand`` is what of it does not move.
        robot: any.
        ends: in its base's frame, m.
        base: where that is, m.
        yaw: by which that is turned, rad.
        touching: which capsules have the colour `TOUCHES`.
        colour: of the other links.
        opacity: of a ghost, whose stand is not drawn.
    """
    tint = np.tile(np.array(colour, np.uint8), (len(robot.capsule_links), 1))
    if touching is not None:
        tint[touching] = TOUCHES
    placed = placed_at(ends, base, yaw)
    drawing.bodies(name, robot_shapes(robot, placed), colours=tint, opacity=opacity)
    if robot.base.kind.size and opacity == 1:
        half = jnp.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        stand = eqx.tree_at(
            lambda o: (o.centre, o.quaternion),
            robot.base,
            (
                jnp.asarray(placed_at(np.asarray(robot.base.centre), base, yaw)),
                quaternion_multiply(half, robot.base.quaternion),
            ),
        )
        drawing.bodies(f"{name}/stand", stand, colours=STAND)


@cache
def _compiled():
    return eqx.filter_jit(capsule_ends)


@cache
def _dual_arm() -> Robot:
    return dual_arm()


def ends_of(robot: Robot, joints: Float[np.ndarray, "J"]) -> Float[np.ndarray, "2 S 3"]:
    """`doojax.robots.capsule_ends`, compiled once a robot."""
    return np.asarray(_compiled()(robot, jnp.asarray(joints, jnp.float32)))


def robot_of(record: TrialRecord) -> Robot | None:
    """The arms of a trial, which are the dual arm; None where its record has no joints.

    Raises:
        ValueError: for joints of something else.
    """
    if "joints" not in record.replay:
        return None
    robot, shape = _dual_arm(), record.replay["joints"].shape
    if shape != (len(record.points), len(robot.joints)):
        raise ValueError(
            f"joints has shape {shape}, expected {len(record.points)} states of the dual arm's "
            f"{len(robot.joints)} joints"
        )
    return robot


def stand_of(record: TrialRecord) -> tuple[tuple[float, float, float], float]:
    """Where the base of a trial's arms stands, m, and by how much it is turned, rad.

    Raises:
        ValueError: the record says it in another way than `doojax.experiments.trials.carried` does.
    """
    said = record.about.get("arms")
    if said is None:
        return BASE, 0.0
    try:
        x, y, z = (float(value) for value in said["base"])
        return (x, y, z), float(said["yaw"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"arms is {said}, expected its base (x, y, z in m) and its yaw (rad)") from error


def corners_of_arms(record: TrialRecord) -> Float[np.ndarray, "K 3"]:
    """Places (m) that a picture of a trial must reach: of its arms, first and last, and of their stand."""
    robot = robot_of(record)
    if robot is None:
        return np.zeros((0, 3))
    known = np.flatnonzero(np.isfinite(record.replay["joints"]).all(1))
    postures = [record.replay["joints"][state] for state in known[[0, -1]]] if known.size else []
    low, high = box_of(robot.base)
    corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3)
    ends = [ends_of(robot, joints).reshape(-1, 3) for joints in postures]
    return placed_at(np.concatenate([corners, *ends]), *stand_of(record))


def show_arms(drawing: Drawing, record: TrialRecord, moment: float) -> None:
    """The arms of a trial at a moment (in states); nothing where its record has no joints."""
    robot = robot_of(record)
    if robot is None:
        return
    joints = record.replay["joints"]
    at = min(max(moment, 0.0), len(joints) - 1)
    before = int(at)
    after = min(before + 1, len(joints) - 1)
    part = at - before
    now = joints[before] if part == 0 else (1 - part) * joints[before] + part * joints[after]
    if np.isfinite(now).all():
        base, yaw = stand_of(record)
        show_robot(drawing, "arms", robot, ends_of(robot, now), base=base, yaw=yaw)
    else:  # no posture is known
        drawing.remove("arms")
