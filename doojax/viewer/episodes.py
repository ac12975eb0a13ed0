"""One trajectory of a data set as everything that shows it needs it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from doojax.datasets import Dataset
from doojax.experiments.trials.records import Look, PredictionRecord, TrialRecord, solid_of
from doojax.tasks import make_task
from doojax.types import Obstacles, ShapeKind
from doojax.viewer import shapes

NEEDED = ("points", "grippers")
PUSHED = ("positions", "hand")  # or these, of bodies that a hand pushes
UNKNOWN_LOOK = Look(rope_radius=0.01)


@dataclass(frozen=True, eq=False)
class Episode:
    """A rope, its grippers and what stands around, over T1 moments; or bodies and a hand that pushes them."""

    points: Float[np.ndarray, "T1 N 3"]  # m, world frame; NaN where the simulation failed
    grippers: Float[np.ndarray, "T1 G 3"]
    obstacles: Obstacles
    look: Look
    period: float = 1.0  # s between two states

    @property
    def ropes(self) -> Float[np.ndarray, "T1 N 3"]:
        """The rope from tip to tip: its outer points moved to where it really ends."""
        return shapes.extended(self.points, self.look.rope_end)

    @property
    def finite(self) -> Bool[np.ndarray, "T1"]:
        """The moments at which the rope's state is known."""
        return np.isfinite(self.points).all(axis=(1, 2))

    @property
    def planar(self) -> bool:
        """Does everything move at one height? Then it is best seen from above."""
        known = self.points[self.finite]
        return not known.size or float(np.ptp(known[..., 2])) < 1e-3

    def corners(self) -> Float[np.ndarray, "K 3"]:
        """Points around which a picture of everything must reach: corners of all bodies, metres."""
        solid = solid_of(self.points, self.grippers, self.look)
        moving = np.concatenate([part.reshape(-1, 3) for part in solid])
        moving = moving[np.isfinite(moving).all(-1)]
        active = np.asarray(self.obstacles.active)
        half = np.asarray(self.obstacles.half_size)[active].astype(np.float32)
        capsule = np.asarray(self.obstacles.kind)[active] == ShapeKind.CAPSULE
        half[capsule, 2] += half[capsule, 0]
        turn = rotation_matrices(np.asarray(self.obstacles.quaternion)[active])
        cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        centre = np.asarray(self.obstacles.centre)[active]
        bodies = centre[:, None] + np.einsum("kij,kcj->kci", turn, cube * half[:, None])
        room = 2 * self.look.rope_radius * cube
        around = (moving[:, None] + room).reshape(-1, 3)
        found = np.concatenate([bodies.reshape(-1, 3), around])
        return found if len(found) else cube.astype(np.float32)


def look_of(config: Mapping[str, Any]) -> tuple[Look, float]:
    """The sizes in a data set's scene and its control period (s), from the task that its config names."""
    try:
        scene = make_task(config.get("task", "")).scene
    except ValueError:  # a task of a package that is not installed here, or none at all
        return UNKNOWN_LOOK, 1.0
    return Look.of(scene), scene.control_period


def require_rope(dataset: Dataset) -> None:
    """Raise ValueError where a data set has nothing to show: no rope, or no complete shard."""
    missing = [name for name in NEEDED if name not in dataset.fields]
    if missing and not holds_pushing(dataset):
        raise ValueError(
            f"{dataset.path} holds no ropes: no field {' and no '.join(missing)}; it has "
            f"{', '.join(dataset.fields)}"
        )
    if not len(dataset):
        raise ValueError(
            f"{dataset.path} is empty: none of its {dataset.manifest.shards} shards is complete yet; the "
            "same collect command goes on with it"
        )


def holds_pushing(dataset: Dataset) -> bool:
    """Is it a data set of bodies that a hand pushes?"""
    return set(PUSHED) <= set(dataset.fields)


def points_field(dataset: Dataset) -> str:
    """What holds the places of what is shown, but for the hands."""
    return PUSHED[0] if holds_pushing(dataset) else NEEDED[0]


def episode(dataset: Dataset, index: int) -> Episode:
    """Trajectory ``index`` of a data set.

    Raises:
        IndexError: outside of it.
        ValueError: for a damaged chunk file, naming it.
    """
    look, period = look_of(dataset.config)
    pushing = holds_pushing(dataset)
    return Episode(
        points=dataset[points_field(dataset)][index],
        grippers=dataset["hand"][index][:, None] if pushing else dataset["grippers"][index],
        obstacles=obstacles_of(dataset, index),
        look=look,
        period=period,
    )


def episode_of(record: PredictionRecord | TrialRecord, trajectory: int = 0) -> Episode:
    """What happened, of a record; of predictions along several trajectories, one of these."""
    if isinstance(record, PredictionRecord):
        states, obstacles = record.states(trajectory), record.obstacles_of(trajectory)
        return Episode(record.points[states], record.grippers[states], obstacles, record.look, record.period)
    return Episode(record.points, record.grippers, record.obstacles, record.look, record.period)


def title(dataset: Dataset) -> str:
    """Task, phase, engine and seed, as far as the config tells."""
    config = dataset.config
    parts = [str(config.get("task", dataset.path.name)).replace("_", " ")]
    parts += [str(config[key]) for key in ("phase", "engine") if key in config]
    return " · ".join(parts + ([f"seed {config['seed']}"] if "seed" in config else []))


def obstacles_of(dataset: Dataset, index: int) -> Obstacles:
    """The obstacles of one trajectory; none where the data set does not store them."""
    if "obstacle_kind" in dataset.fields:
        return dataset.obstacles(index)
    return no_obstacles()


def no_obstacles() -> Obstacles:
    """A scene in which nothing stands."""
    import jax.numpy as jnp

    return Obstacles(
        kind=jnp.zeros(0, int),
        centre=jnp.zeros((0, 3)),
        quaternion=jnp.zeros((0, 4)),
        half_size=jnp.zeros((0, 3)),
        active=jnp.zeros(0, bool),
    )


def rotation_matrices(quaternions: Float[np.ndarray, "K 4"]) -> Float[np.ndarray, "K 3 3"]:
    """Rotation matrices of unit quaternions (w, x, y, z); columns are the body's axes.

    In numpy, because a picture asks for few of them at a time, from Python.
    """
    w, x, y, z = np.asarray(quaternions, dtype=np.float32).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
