"""What augmentation is worth where data are few: `doojax augmentation-study`.

Each seed has trajectories of its own, and each method makes of them what one network learns from; all are
measured on the same trajectories that none has seen. All networks take equally many steps, so that more data
do not mean more training. Seeds are pairs: same trajectories, another method.
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from doojax.commands import command_line
from doojax.datasets import Dataset
from doojax.datasets.collect import collect
from doojax.datasets.files import MANIFEST
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import bootstrap, paired_t, permutation
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.experiments.sweeps.pushing_sets import METHODS, PushingSet, learned_vaes, made, vae_fit
from doojax.experiments.training.train import training_progress
from doojax.files import file_digest
from doojax.learning.fit import fit, member
from doojax.learning.pushing import (
    PropNetProblem,
    PushingData,
    PushingPresetName,
    measured,
    pushing_preset,
    stay_error,
)
from doojax.learning.runs import RunDirectory
from doojax.tasks import make_task

TASK = "planar_pushing"
VALIDATION, TEST = 16, 64  # trajectories
STATES = 50  # of a trajectory


def augmentation_study(
    *,
    out: Path,
    methods: tuple[str, ...] = ("none", "augmentation", "noise"),
    seeds: int = 10,
    trajectories: int = 60,
    copies: int = 25,
    preset: PushingPresetName = "quick",
    epochs: int | None = None,
    seed: int = 0,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Train PropNet with and without augmentation on planar pushing, and compare on unseen trajectories.

    Killed, it goes on where it was when the same command is given again.

    Args:
        out: the folder of data and of the training run; new, empty, or the same study unfinished.
        methods: none, augmentation (moved rigidly to where it is valid), the same without the gradient of one
            term (no_occupancy, no_distance), whole (all that stands there moved, too, which needs no check),
            noise (Gaussian), random (moved rigidly, valid or not), vae (a variational autoencoder of each
            set).
        seeds: sets of trajectories, and networks for each method.
        trajectories: of a set.
        copies: made of each trajectory by a method that makes any; of augmentations, those accepted count.
        preset: of network and training: quick, thesis, or thesis_network, trained as the quick one.
        epochs: in place of the preset's.
        seed: of everything that is random.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures; by default they are only shown.

    Raises:
        ValueError: for an unknown method, a count below 1, or a folder that holds something else.
    """
    command = command_line(augmentation_study, locals())
    unknown = sorted(set(methods) - set(METHODS))
    if unknown or not methods:
        raise ValueError(f"methods are {', '.join(methods)}; expected some of {', '.join(METHODS)}")
    for name, count in (("seeds", seeds), ("trajectories", trajectories), ("copies", copies)):
        if count < 1:
            raise ValueError(f"{name} is {count}, expected at least 1")
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    task = make_task(TASK)
    chosen = pushing_preset(preset, len(task.scene.cylinders), task.scene.control_period)
    config = replace(chosen.fit, members=len(methods) * seeds, epochs=epochs or chosen.fit.epochs)
    # others' seeds than those of the sets, which are 2 n + 2: no trajectory is in two of them
    held_out = _collected(out / "held_out", VALIDATION + TEST, 2 * seed + 1)
    every = PushingData.of(held_out.states(np.arange(len(held_out))))
    validation, test = (
        jax.tree.map(lambda leaf, rows=rows: leaf[rows], every)
        for rows in (slice(0, VALIDATION), slice(VALIDATION, None))
    )
    sets, files = [], {"held out": out / "held_out"}
    for number in range(seeds):
        folder = out / f"set{number}"
        data = _collected(folder, trajectories, 2 * (seed * seeds + number) + 2)
        sets.append(PushingSet(folder, data, PushingData.of(data.states(np.arange(len(data)))), number))
        files[f"set {number}"] = folder
    digests = {name: file_digest(path / MANIFEST)[:16] for name, path in files.items()}
    vaes = None
    if "vae" in methods:
        run = RunDirectory.open(out / "vae", {"fit": asdict(vae_fit(seeds)), "inputs": digests})
        with training_progress(console, "autoencoders") as report:
            vaes = learned_vaes(sets, validation, run, report, seed)
    by_method = [made(method, sets, task, copies, seed, vaes) for method in methods]
    parts = [part for parts in zip(*by_method, strict=True) for part in parts]
    counts = np.array([len(part) for part in parts])
    train = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    problem = PropNetProblem(train, validation, chosen.network, chosen.window, chosen.steps)
    settings = {"network": asdict(chosen.network), "fit": asdict(config), "window": chosen.window}
    settings |= {"steps": chosen.steps, "methods": list(methods), "seeds": seeds, "seed": seed}
    run = RunDirectory.open(out / "training", {**settings, "copies": copies, "inputs": digests})
    members = (jnp.asarray(np.cumsum(counts) - counts), jnp.asarray(counts))
    with training_progress(console, "propnet") as report:
        models = fit(problem, config, seed=seed, run=run, members=members, report=report)
    found = [measured(member(models, index), test) for index in range(config.members)]
    tags = {"task": TASK, "trajectories": trajectories, "preset": preset}
    tags |= {"steps": config.epochs * chosen.steps, "seed": seed}  # which says what they are measured on
    rows = [row("position_error_m", tags | {"method": "nothing_moves"}, stay_error(test), "m")]
    rows += _rows(methods, seeds, tags, found)
    share = counts.reshape(seeds, len(methods)) / trajectories
    for method, kept in zip(methods, share.T, strict=True):
        console.print(f"{method}: {kept.mean():.1f} trajectories to learn from for each that was simulated")
    publish_rows(publish, command=command, seed=seed, rows=rows, inputs=digests)
    show(rows, json)


def _collected(folder: Path, count: int, seed: int) -> Dataset:
    collect(TASK, trajectories=count, states=STATES, engine="mujoco", seed=seed, out=folder)
    return Dataset.open(folder)


def _rows(
    methods: tuple[str, ...], seeds: int, tags: dict[str, Any], found: list[dict[str, Any]]
) -> list[Row]:
    """Figures of networks; members are the methods of the first seed, those of the second, ..."""
    of = {
        name: np.array([float(one[name]) for one in found]).reshape(seeds, len(methods)) for name in found[0]
    }
    rows = []
    for column, method in enumerate(methods):
        for name, values in of.items():
            estimate = bootstrap(values[:, column])
            its = tags | {"method": method}
            rows.append(row(f"{name}_m", its, estimate.value, "m", estimate.low, estimate.high, seeds))
    if "augmentation" not in methods or seeds < 2:
        return rows
    errors = of["position_error"]
    ours = errors[:, methods.index("augmentation")]
    for column, method in enumerate(methods):
        if method == "augmentation":
            continue
        against = tags | {"against": method}
        less = bootstrap(1 - ours / errors[:, column])
        rows.append(row("error_reduction", against, less.value, "", less.low, less.high, seeds))
        for test in (paired_t, permutation):
            p_value = test(ours, errors[:, column]).p_value
            rows.append(row("p_value", against | {"test": test.__name__}, p_value, "", n=seeds))
    return rows
