"""What studies of adaptation share: checks of what is asked for, seeds of purposes, data, source networks."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from doojax.datasets.files import MANIFEST
from doojax.files import file_digest
from doojax.keys import stream
from doojax.learning.adaptation import METHODS, AdaptationMethod
from doojax.learning.data import Trajectories, load_split, open_dataset
from doojax.learning.fit import Report, fit
from doojax.learning.losses import DynamicsProblem
from doojax.learning.presets import dynamics_preset
from doojax.learning.runs import RunDirectory
from doojax.tasks.base import Task


class Counts:
    """A frozen dataclass of counts that refuses those below 1."""

    def __post_init__(self):
        """Refuse too little."""
        for name, value in vars(self).items():
            if value < 1:
                raise ValueError(f"{name} is {value}, expected at least 1")


def require_study(methods: tuple[AdaptationMethod, ...], seeds: int, **chosen: tuple[Any, Any]) -> None:
    """Raise ValueError for what no study of adaptation can do.

    Args:
        methods: some of `METHODS`.
        seeds: at least 1.
        chosen: what else is chosen from names, by what it is called: what is given, and what is known.
    """
    for name, (given, known) in {**chosen, "methods": (methods, METHODS)}.items():
        unknown = sorted(set(given) - set(known))
        if unknown or not given:
            raise ValueError(f"{name} are {', '.join(given)}; expected some of {', '.join(known)}")
    if seeds < 1:
        raise ValueError(f"seeds is {seeds}, expected at least 1")


def seed_of(seed: int, *names: str) -> int:
    """The seed of a purpose: two purposes have the same one by a chance of one in 2^63."""
    high, low = np.asarray(jax.random.key_data(stream(seed, "adaptation study", *names)), dtype=np.uint64)
    return int((high << np.uint64(32) | low) >> np.uint64(1))


def all_splits(folder: Path) -> Trajectories:
    """Every sound trajectory of a data set."""
    dataset = open_dataset(folder)
    parts = [load_split(dataset, split) for split in ("train", "validation", "calibration", "test")]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def source_models(
    out: Path,
    task: Task,
    seeds: int,
    epochs: int,
    seed: int,
    report: Report,
    prepared: Callable[[Trajectories], Trajectories] = lambda data: data,
) -> Any:
    """One network for each seed, all trained on the source's data, of which ``prepared`` makes examples."""
    dataset = open_dataset(out / "source")
    chosen = dynamics_preset("quick", task)
    config = replace(chosen.fit, members=seeds, epochs=epochs)
    train, validation = (prepared(load_split(dataset, split)) for split in ("train", "validation"))
    problem = DynamicsProblem(train, validation, chosen.network, True)
    about = {"network": asdict(chosen.network), "fit": asdict(config), "seed": seed}
    about["data"] = file_digest(out / "source" / MANIFEST)[:16]
    run = RunDirectory.open(out / "source_models", about)
    return fit(problem, config, seed=seed, run=run, report=report)
