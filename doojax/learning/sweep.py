"""How classifiers depend on the threshold of the model error: all of them trained at once."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from doojax.datasets.files import MANIFEST
from doojax.learning.calibration import fit_calibration
from doojax.learning.data import load_split
from doojax.learning.fit import Report, fit, member
from doojax.learning.labels import label
from doojax.learning.metrics import auroc, counts
from doojax.learning.presets import PresetName, classifier_preset, labels_preset
from doojax.learning.reliability import ClassifierProblem, judged_kept, require_both_classes
from doojax.learning.train import judged_data, model_file, open_run
from doojax.models.classifier import DistanceClassifier

FRACTIONS = (0.5, 0.75, 1.0, 1.5, 2.0)  # of the dynamics' own threshold


@dataclass(frozen=True)
class Measured:
    """One classifier on the test split, at the threshold that it was trained for."""

    threshold_m: float
    seed: int
    transitions: int  # that begin where the prediction was still right
    right_fraction: float
    accuracy: float
    precision: float  # NaN if nothing was accepted
    recall: float
    auroc: float


def sweep_thresholds(
    data: Path,
    out: Path,
    dynamics: Path,
    thresholds: Sequence[float],
    seeds: int,
    preset: PresetName,
    epochs: int,
    trajectories: int,
    seed: int,
    report: Report,
) -> tuple[str, float, list[Measured]]:
    """Train a classifier from distances for every threshold and seed as members of one `fit`, and judge them.

    Each is calibrated on the calibration split and accepts what is more likely right than wrong.

    Args:
        data: a data set of phase constrained.
        out: the run's folder; new, empty, or the same sweep unfinished.
        dynamics: the run or model.eqx whose predictions are judged.
        thresholds: of the model error, m; none: `FRACTIONS` of the dynamics' own.
        seeds: classifiers for each.
        preset: of the network and the labels.
        epochs: of training.
        trajectories: of the train, validation and calibration splits, at most; the test split is used whole.
        seed: of everything that is random.
        report: called after each epoch.

    Returns:
        the task's name, the dynamics' own threshold (m), and the figures, thresholds ascending.

    Raises:
        ValueError: as `doojax.learning.train.train_classifier`, and for thresholds that are not positive or
            not different, no seeds or no trajectories.
    """
    for name, count in (("seeds", seeds), ("trajectories", trajectories)):
        if count < 1:
            raise ValueError(f"{name} is {count}, expected at least 1")
    if len(set(thresholds)) < len(thresholds) or not all(threshold > 0 for threshold in thresholds):
        raise ValueError(f"thresholds are {list(thresholds)}, expected different positive lengths (m)")
    dataset, ensemble, task, own, _ = judged_data(data, dynamics, None)
    chosen = sorted(thresholds) or [fraction * own for fraction in FRACTIONS]
    labels = labels_preset(preset)
    network = classifier_preset(preset, task)
    members = jnp.repeat(jnp.array(chosen), seeds)
    network = replace(network, fit=replace(network.fit, epochs=epochs, members=len(members)))
    parts = {split: load_split(dataset, split) for split in ("train", "validation", "calibration", "test")}
    for split in ("train", "validation", "calibration"):
        parts[split] = jax.tree.map(lambda leaf: leaf[:trajectories], parts[split])
    examples = {split: label(ensemble, part, labels) for split, part in parts.items()}
    for split, some in examples.items():
        for threshold in chosen:
            require_both_classes(some, threshold, split)
    files = {"data": data / MANIFEST, "dynamics": model_file(dynamics)}
    settings = {"thresholds_m": chosen, "seeds": seeds, "trajectories": trajectories}
    settings["labels"] = asdict(labels)
    run = open_run(out, "threshold_sweep", task.name, network, seed, files, **settings)
    problem = ClassifierProblem(
        examples["train"],
        parts["train"].obstacles,
        examples["validation"],
        parts["validation"].obstacles,
        DistanceClassifier,
        network.network,
    )
    models = fit(problem, network.fit, seed=seed, run=run, members=members, report=report)
    measured = []
    for i, threshold in enumerate(np.repeat(chosen, seeds)):
        model = member(models, i)
        spare, test = (
            judged_kept(model.logit, examples[split], parts[split].obstacles, float(threshold))
            for split in ("calibration", "test")
        )
        scores = np.asarray(fit_calibration(*spare)(jnp.asarray(test[0])))
        measured.append(judge(scores, test[1], float(threshold), i % seeds))
    return task.name, own, measured


def judge(
    scores: Float[np.ndarray, "n"], right: Bool[np.ndarray, "n"], threshold: float, seed: int
) -> Measured:
    """The figures of one classifier's probabilities."""
    found = counts(scores > 0.5, right)
    figures: dict[str, Any] = {name: getattr(found, name) for name in ("accuracy", "precision", "recall")}
    return Measured(
        threshold_m=threshold,
        seed=seed,
        transitions=len(right),
        right_fraction=float(right.mean()),
        auroc=auroc(scores, right),
        **{name: float(value) for name, value in figures.items()},
    )
