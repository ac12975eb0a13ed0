"""A chain of links laid along a polyline: the joint positions that place it there."""

import mujoco
import numpy as np
from jaxtyping import Float

from doojax.simulation.build import build_model
from doojax.simulation.rope import link_name
from doojax.simulation.scenes import Scene


def laid(
    scene: Scene, qpos: Float[np.ndarray, "nq"], points: Float[np.ndarray, "N1 3"]
) -> Float[np.ndarray, "nq"]:
    """``qpos`` with the rope's links laid along a polyline, without twist.

    Args:
        scene: one whose rope is a capsule chain.
        qpos: of everything else.
        points: where links begin, and where the last ends, m; only the directions between them count, and
            the middle link's place, so steps need not be exactly a link long.

    Raises:
        ValueError: for another number of points than of links and one, two that coincide, or another rope.
    """
    if scene.rope_model is None or scene.rope_model.kind != "capsule_chain":
        raise ValueError(f"scene {scene.name!r} has no capsule chain that could be laid")
    steps = points[1:] - points[:-1]
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    if len(steps) != scene.links or not (lengths > 0).all():
        raise ValueError(f"{len(points)} points, expected {scene.links + 1}, no two in a row the same")
    axes, middle, model = steps / lengths, scene.links // 2, build_model(scene)
    qpos = np.array(qpos, float)
    turns = {middle: _turn_to(axes[middle])}
    root = turns[middle]
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, root.ravel())
    at = points[middle] + axes[middle] * scene.rope_part.parameters.length / scene.links / 2
    qpos[scene.layout.places["rope"].qpos] = [*at, *quaternion]
    for link in sorted(set(range(scene.links)) - {middle}, key=lambda i: abs(i - middle)):
        parent = turns[link - 1 if link > middle else link + 1]
        x, y, z = parent.T @ axes[link]
        about_y, about_z = np.arctan2(-z, x), np.arcsin(np.clip(y, -1, 1))
        for name, angle in (("bend_y", about_y), ("bend_z", about_z)):
            qpos[model.joint(f"{link_name(link)}_{name}").qposadr[0]] = angle
        turns[link] = parent @ _about(1, about_y) @ _about(2, about_z)
    return qpos


def _turn_to(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """A rotation whose first column is ``axis``."""
    return _about(2, np.arctan2(axis[1], axis[0])) @ _about(1, -np.arcsin(np.clip(axis[2], -1, 1)))


def _about(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
    """The rotation by an angle (rad) about x, y or z."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[one, one] = turn[other, other] = np.cos(angle)
    turn[other, one] = np.sin(angle)
    turn[one, other] = -np.sin(angle)
    return turn
