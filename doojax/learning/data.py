"""Trajectories of a split, ready to learn from."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from doojax.datasets.store import Dataset
from doojax.tasks.ropes import task_of
from doojax.types import Obstacles, RopeState


class Trajectories(eqx.Module):
    """K sound trajectories of T actions: no fault, no missing value."""

    states: Any  # such as a RopeState: points [K, T+1, N, 3], grippers [K, T+1, G, 3]
    actions: Float[Array, "K T ..."]  # such as displacements, m
    obstacles: Obstacles  # [K, M]
    rows: Int[Array, "K"]  # their numbers in the data set

    def __len__(self) -> int:
        """K."""
        return self.actions.shape[0]

    def transitions(self) -> tuple[Any, Float[Array, "n ..."], Any]:
        """All n = K T states that something was done in, what was done, and the states after."""
        before = jax.tree.map(lambda leaf: leaf[:, :-1].reshape(-1, *leaf.shape[2:]), self.states)
        after = jax.tree.map(lambda leaf: leaf[:, 1:].reshape(-1, *leaf.shape[2:]), self.states)
        return before, self.actions.reshape(-1, *self.actions.shape[2:]), after


def open_dataset(path: Path, *, task: str | None = None) -> Dataset:
    """A complete data set of a task.

    Raises:
        ValueError: it is unfinished, or of another task.
    """
    dataset = Dataset.open(path)
    found = dataset.config.get("task")
    if task is not None and found != task:
        raise ValueError(f"{path} holds data of the task {found!r}, expected {task!r}")
    return dataset


def load_split(dataset: Dataset, split: str) -> Trajectories:
    """The sound trajectories of one split, "train", "validation", "calibration" or "test".

    Raises:
        ValueError: none is left.
    """
    rows = dataset.split(split)
    ropes = {"points", "grippers"} <= set(dataset.fields)
    stored = dataset.trajectories(rows, RopeState if ropes else type(task_of(dataset.config).blank))
    sound = (np.asarray(stored.faults) == 0).all(1)
    for leaf in jax.tree.leaves(stored.states):
        sound &= np.isfinite(np.asarray(leaf)).all(axis=tuple(range(1, leaf.ndim)))
    if not sound.any():
        raise ValueError(f"{dataset.path}: every trajectory of the {split} split has a fault")
    keep = np.flatnonzero(sound)
    pick = lambda tree: jax.tree.map(lambda leaf: leaf[keep], tree)  # noqa: E731
    return Trajectories(
        states=pick(stored.states),
        actions=stored.actions[keep],
        obstacles=pick(dataset.obstacles(rows)),
        rows=jnp.asarray(rows[keep]),
    )
