"""A container that pours, moment by moment: particles, containers and plant.

A data set holds what learners see, not the fluid: it is simulated again, from the stored start.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.datasets import Dataset
from doojax.datasets.replay import stored_starts
from doojax.experiments.drawing import Colour, Drawing
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.replay import start_of
from doojax.experiments.trials.volumes import said_of, volumes_of
from doojax.simulation.fluid.containers import boxes_of
from doojax.simulation.fluid.pouring import PouringScene, PouringSimulator, split
from doojax.simulation.state import SimState
from doojax.tasks import make_task
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


class Flow(NamedTuple):
    """What a container and its fluid do, F moments."""

    scene: PouringScene
    places: Float[np.ndarray, "F P 3"]  # of the particles, m
    poses: Float[np.ndarray, "F 3"]  # x and z (m) of the container, and its angle (rad)

    def show(self, drawing: Drawing, moment: float) -> None:
        """Draw both at a moment, counted from 0; beyond the last, that."""
        x, z, angle = self.poses[min(round(moment), len(self.poses) - 1)]
        place = jnp.array([x, 0.0, z], jnp.float32)
        own = boxes_of(self.scene.container, place, jnp.asarray(angle, jnp.float32))
        fluid = self.places[min(round(moment), len(self.places) - 1)]
        drawing.spheres("flow/fluid", fluid, radius=self.scene.fluid.radius, colours=WATER)
        drawing.obstacles("flow/container", own, colour=GLASS, opacity=THIN)


def simulated_again(record: TrialRecord) -> tuple[Flow, Obstacles]:
    """A trial of a container from its first state by its actions, `EVERY` looks apart, and what stands there.

    Raises:
        ValueError: for a record that does not hold them.
    """
    simulator: Any = make_task(record.task).simulator()
    start = jax.tree.map(lambda leaf: leaf[0], start_of(record))
    return flow_of(simulator, start, jnp.asarray(record.replay["actions"])), simulator.obstacles(start)


def per_state(scene: PouringScene) -> int:
    """Moments of a `Flow` between two states."""
    return scene.looks // EVERY


def film_of_pour(record: TrialRecord) -> Film:
    """A trial of a container, simulated again.

    Raises:
        ValueError: for a record that does not hold what it takes.
    """
    flow, obstacles = simulated_again(record)
    poured, spilled = volumes_of(record)[-1]
    title = f"{record.task.replace('_', ' ')} · {record.method} · seed {record.seed}: {record.end}, "
    return film_from(flow, obstacles, title + said_of(poured, spilled))


def film_of(simulator: PouringSimulator, start: SimState, actions: Float[Array, "T 1 3"], title: str) -> Film:
    """What a simulator does from a start with some actions."""
    return film_from(flow_of(simulator, start, actions), simulator.obstacles(start), title)


def flow_of(simulator: PouringSimulator, start: SimState, actions: Float[Array, "T 1 3"]) -> Flow:
    """What a simulator does from a start with some actions, `EVERY` looks apart."""
    scene = simulator.scene
    flow, poses = (np.asarray(leaf) for leaf in _simulated(simulator, start, actions))
    first, pose = split(scene, start.qpos)
    flow = np.concatenate([np.asarray(first)[None], flow])[::EVERY]
    if flow.shape[2] == 2:
        flow = np.insert(flow, 1, 0.0, axis=2)
    return Flow(scene, flow, np.concatenate([np.asarray(pose)[None], poses])[::EVERY])


def film_from(flow: Flow, obstacles: Obstacles, title: str) -> Film:
    """A film of moments that are `EVERY` looks of the controller apart.

    Args:
        flow: what moves.
        obstacles: the receiver's boxes first, then the plant's.
        title: of the film.
    """
    poses = flow.poses
    obstacles = jax.tree.map(np.asarray, obstacles)
    there = np.asarray(obstacles.active)
    ends = [obstacles.centre[there] + sign * obstacles.half_size[there] for sign in (-1, 1)]
    sides = np.array([[-0.2, 0.0, 0.0], [0.2, 0.0, 0.25]])
    moving = (np.stack([poses[:, 0], 0 * poses[:, 0], poses[:, 1]], axis=1)[:, None] + sides).reshape(-1, 3)

    def show(drawing: Drawing, moment: float) -> None:
        drawing.obstacles("receiver", _some(obstacles, slice(0, WALLS)), colour=GLASS, opacity=THIN)
        drawing.obstacles("plant", _some(obstacles, slice(WALLS, None)), colour=LEAVES, opacity=LEAFY)
        flow.show(drawing, moment)

    corners = np.concatenate([*ends, moving]).astype(np.float32)
    corners[:, 1] = np.clip(corners[:, 1], -0.2, 0.2)
    return Film(
        title=title,
        corners=corners,
        floor=0.0,
        planar=False,
        states=len(poses),
        period=EVERY * flow.scene.look,
        set_up=lambda drawing: None,  # what is translucent is drawn over what moves, so with it
        show=show,
        seen_from=FROM_FRONT,
    )


@eqx.filter_jit
def _simulated(simulator: PouringSimulator, start: SimState, actions: Array) -> tuple[Array, Array]:
    return simulator.films(start, actions)


def _some(obstacles: Obstacles, chosen: slice) -> Obstacles:
    return jax.tree.map(lambda leaf: leaf[chosen], obstacles)
