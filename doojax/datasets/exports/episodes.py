"""A data set's trajectories as episodes: what is seen and done at each step, with names, units and splits."""

from dataclasses import asdict, dataclass, fields
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Int, Shaped

from doojax.datasets.splits import split_by_environment
from doojax.datasets.states import state_names
from doojax.datasets.store import Dataset
from doojax.tasks.ropes import task_of
from doojax.types import Obstacles

OBSTACLES = tuple(f"obstacle_{one.name}" for one in fields(Obstacles))
MEASURED = ("clearance", "stretch")  # of each state
ONE = {  # what one of a field's rows is called
    "points": "point",
    "grippers": "gripper",
    "positions": "position",
    "velocities": "velocity",
    "volumes": "volume",
    "actions": "action",
}


@dataclass(frozen=True, eq=False)
class Episodes:
    """K episodes of T actions, in the order of their splits; those without values are left out.

    What is not here serves replays: positions of all joints at the start, obstacle bodies.
    """

    dataset: Dataset
    task: str  # its name
    text: str  # what is done, in a few words
    period: float  # s, from one state to the next
    trajectory: Int[np.ndarray, "K"]  # their numbers in the data set
    environment: Int[np.ndarray, "K"]  # those with one number share a scene
    splits: dict[str, range]  # of episodes; a split without any is missing
    left_out: int  # trajectories without values
    arrays: dict[str, Shaped[np.ndarray, "K ..."]]  # by field

    def __len__(self) -> int:
        """How many episodes."""
        return len(self.trajectory)

    @property
    def steps(self) -> int:
        """Actions in an episode; states are one more."""
        return self.arrays["actions"].shape[1]

    @cached_property
    def states(self) -> tuple[str, ...]:
        """The fields of states, [K, T+1, ...]."""
        return state_names(self.dataset.fields)[1]

    @property
    def obstacles(self) -> tuple[str, ...]:
        """The fields of obstacles, [K, ...], equal for all steps; none where a scene has none."""
        return tuple(name for name in OBSTACLES if name in self.arrays)

    @property
    def measured(self) -> tuple[str, ...]:
        """What was measured of each state, [K, T+1]."""
        return tuple(name for name in MEASURED if name in self.arrays)

    def split_of(self, episode: int) -> str:
        """The split that an episode is in."""
        return next(name for name, episodes in self.splits.items() if episode in episodes)

    def coordinates(self, name: str) -> list[str]:
        """A name for each number of a field at one step, in the order of its flat array."""
        varying = name not in OBSTACLES
        return coordinates(name, self.dataset.fields[name].shape[varying:], self.dataset.fields[name].unit)

    def about(self) -> dict[str, Any]:
        """What made the data, and what their fields are, for a reader of the export."""
        manifest = self.dataset.manifest
        told = [name for name in manifest.fields if name in (*self.arrays, "environment")]
        return {
            "config": manifest.config,
            "versions": manifest.versions,
            "control_period_s": self.period,
            "left_out_without_values": self.left_out,
            "left_out": [name for name in manifest.fields if name not in told],
            "fields": {
                name: {**asdict(manifest.fields[name]), "coordinates": self.coordinates(name)}
                for name in told
            },
        }


def episodes_of(dataset: Dataset) -> Episodes:
    """The episodes of a complete data set, in memory.

    Raises:
        ValueError: it is unfinished, holds no states or no trajectory with values, or its task is unknown.
    """
    if not dataset.complete:
        raise ValueError(f"{dataset.path} is unfinished and has no splits yet: resume its collection first")
    task = task_of(dataset.config)
    wanted = (*state_names(dataset.fields)[1], *MEASURED, *OBSTACLES, "actions", "faults")
    arrays = {name: dataset[name][:] for name in wanted if name in dataset.fields}
    whole = np.ones(len(dataset), bool)
    for values in arrays.values():
        whole &= np.isfinite(values).reshape(len(values), -1).all(-1)
    if not whole.any():
        raise ValueError(f"no trajectory of {dataset.path} has values throughout: see doojax inspect")
    environment = dataset["environment"][:] if "environment" in dataset.fields else dataset.rows
    found = split_by_environment(environment)
    kept = {name: rows[whole[rows]] for name, rows in found.items()}
    order = np.concatenate(list(kept.values()))
    ends = np.cumsum([len(rows) for rows in kept.values()])
    splits = {name: range(end - len(kept[name]), end) for name, end in zip(kept, ends.tolist(), strict=True)}
    return Episodes(
        dataset=dataset,
        task=dataset.config["task"],
        text=_text(dataset.config),
        period=float(task.scene.control_period),
        trajectory=order,
        environment=environment[order],
        splits={name: episodes for name, episodes in splits.items() if episodes},
        left_out=int((~whole).sum()),
        arrays={name: values[order] for name, values in arrays.items()},
    )


def coordinates(name: str, shape: tuple[int, ...], unit: str) -> list[str]:
    """Names such as point3_x for the numbers of an array [*shape], in the order of its flat array."""
    axes: tuple[str, ...] = ()
    if shape and name.endswith("quaternion"):
        axes = ("w", "x", "y", "z")
    elif shape[-1:] == (3,) and unit in ("m", "m/s") and (name != "actions" or len(shape) > 1):
        axes = ("x", "y", "z")
    indices = product(*(range(size) for size in shape[: len(shape) - bool(axes)]))
    heads = [ONE.get(name, name) + "_".join(map(str, index)) for index in indices]
    return [f"{head}_{axis}" for head in heads for axis in axes] if axes else heads


def _text(config: dict[str, Any]) -> str:
    if "imported" in config:
        return f"{config['task']}: trajectories from elsewhere"
    if "augmentation" in config:
        return f"{config['task']}: augmented trajectories of random actions"
    return f"{config['task']}: random actions"
