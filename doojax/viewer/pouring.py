"""A container that pours, moment by moment: particles, containers and plant.

A data set holds what learners see, not the fluid: it is simulated again, from the stored start.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.datasets import Dataset
from doojax.datasets.replay import stored_starts
from doojax.experiments.drawing import Colour, Drawing
from doojax.simulation.fluid.containers import boxes_of
from doojax.simulation.fluid.pouring import PouringScene, PouringSimulator, split
from doojax.simulation.state import SimState
from doojax.tasks.ropes import task_of
from doojax.types import Obstacles
from doojax.viewer.films import Film

WATER: Colour = (0, 114, 178)
GLASS: Colour = (150, 165, 185)
LEAVES: Colour = (60, 140, 70)
WALLS = 5  # boxes of a container, and the first of the obstacles: those of the receiver
EVERY = 8  # looks of the controller between two states of a film
FROM_FRONT = np.array([-0.12, -0.95, 0.28]) / np.linalg.norm([-0.12, -0.95, 0.28])
THIN, LEAFY = 0.22, 0.45  # opacities


def holds_pouring(dataset: Dataset) -> bool:
    """Is it a data set of containers that pour?"""
    return {"container", "volumes", "receiver"} <= set(dataset.fields)


def film_of_pouring(dataset: Dataset, index: int) -> Film:
    """A trajectory of a data set, simulated again."""
    task = task_of(dataset.config)
    simulator: Any = task.simulator()
    start = jax.tree.map(lambda leaf: leaf[0], stored_starts(dataset, np.array([index])))
    actions = jnp.asarray(dataset["actions"][index])
    name = str(dataset.config["task"]).replace("_", " ")
    phase = dataset.config.get("phase", "")
    return film_of(simulator, start, actions, f"{name} · {phase}   #{dataset.rows[index]}")


def film_of(simulator: PouringSimulator, start: SimState, actions: Float[Array, "T 1 3"], title: str) -> Film:
    """What a simulator does from a start with some actions."""
    scene = simulator.scene
    flow, poses = (np.asarray(leaf) for leaf in _simulated(simulator, start, actions))
    first, pose = split(scene, start.qpos)
    flow = np.concatenate([np.asarray(first)[None], flow])[::EVERY]
    poses = np.concatenate([np.asarray(pose)[None], poses])[::EVERY]
    return film_from(scene, simulator.obstacles(start), flow, poses, title)


def film_from(
    scene: PouringScene,
    obstacles: Obstacles,
    flow: Float[np.ndarray, "F P D"],
    poses: Float[np.ndarray, "F 3"],
    title: str,
) -> Film:
    """A film of F moments, `EVERY` looks of the controller apart.

    Args:
        scene: what is shown.
        obstacles: the receiver's boxes first, then the plant's.
        flow: places of the particles, m.
        poses: x and z (m) of the container, and its angle (rad).
        title: of the film.
    """
    if flow.shape[2] == 2:
        flow = np.insert(flow, 1, 0.0, axis=2)
    obstacles = jax.tree.map(np.asarray, obstacles)
    there = np.asarray(obstacles.active)
    ends = [obstacles.centre[there] + sign * obstacles.half_size[there] for sign in (-1, 1)]
    sides = np.array([[-0.2, 0.0, 0.0], [0.2, 0.0, 0.25]])
    moving = (np.stack([poses[:, 0], 0 * poses[:, 0], poses[:, 1]], axis=1)[:, None] + sides).reshape(-1, 3)

    def set_up(drawing: Drawing) -> None:
        drawing.obstacles("receiver", _some(obstacles, slice(0, WALLS)), colour=GLASS, opacity=THIN)
        drawing.obstacles("plant", _some(obstacles, slice(WALLS, None)), colour=LEAVES, opacity=LEAFY)

    def show(drawing: Drawing, moment: float) -> None:
        x, z, angle = poses[min(round(moment), len(poses) - 1)]
        place = jnp.array([x, 0.0, z], jnp.float32)
        own = boxes_of(scene.container, place, jnp.asarray(angle, jnp.float32))
        set_up(drawing)
        drawing.spheres(
            "fluid", flow[min(round(moment), len(flow) - 1)], radius=scene.fluid.radius, colours=WATER
        )
        drawing.obstacles("container", own, colour=GLASS, opacity=THIN)

    corners = np.concatenate([*ends, moving]).astype(np.float32)
    corners[:, 1] = np.clip(corners[:, 1], -0.2, 0.2)
    return Film(
        title=title,
        corners=corners,
        floor=0.0,
        planar=False,
        states=len(poses),
        period=EVERY * scene.look,
        set_up=lambda drawing: None,  # what is translucent is drawn over what moves, so with it
        show=show,
        seen_from=FROM_FRONT,
    )


@eqx.filter_jit
def _simulated(simulator: PouringSimulator, start: SimState, actions: Array) -> tuple[Array, Array]:
    return simulator.films(start, actions)


def _some(obstacles: Obstacles, chosen: slice) -> Obstacles:
    return jax.tree.map(lambda leaf: leaf[chosen], obstacles)
