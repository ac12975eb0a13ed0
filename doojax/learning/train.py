"""From data sets to trained models: one function a kind, all resumable."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from doojax.datasets.files import MANIFEST
from doojax.datasets.store import Dataset
from doojax.files import file_digest
from doojax.keys import stream
from doojax.learning.calibration import conformal_threshold, fit_calibration
from doojax.learning.checkpoints import MODEL, Header, load_model, own_threshold
from doojax.learning.data import load_split, open_dataset
from doojax.learning.deviation import DeviationConfig, calibrated, deviation_examples, fit_deviation
from doojax.learning.fit import Report, fit, member
from doojax.learning.full_dynamics import AT_ONCE, windows
from doojax.learning.labels import error_threshold, label
from doojax.learning.losses import DynamicsProblem
from doojax.learning.presets import (
    Preset,
    PresetName,
    classifier_preset,
    deviation_preset,
    dynamics_preset,
    full_dynamics_preset,
    labels_preset,
    recovery_preset,
    voxel_classifier_preset,
)
from doojax.learning.provenance import SAW, seen_data
from doojax.learning.recovery import RecoveryProblem, label_recovery
from doojax.learning.reliability import ClassifierProblem, judged_kept, require_both_classes
from doojax.learning.runs import RunDirectory
from doojax.models.classifier import DistanceClassifier
from doojax.models.ensemble import Ensemble
from doojax.models.full_dynamics import FullDynamics
from doojax.models.voxel_classifier import VoxelClassifier
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.types import PouringState

ALPHAS = (0.05, 0.1)  # rates of wrong predictions among the accepted, for which thresholds are found
FEWEST_RECOVERIES = 200  # examples
BIAS = 10.0  # k_h of equation 4.2, 1/m of the norm of all coordinates, as in the thesis
POURING_BIAS = 1.0  # that of the released code for water: with 10, what spills everything would not count
ClassifierKind = Literal["classifier", "voxel_classifier"]
CLASSIFIERS: dict[str, tuple[Any, Callable[[PresetName, Task], Preset]]] = {
    "classifier": (DistanceClassifier, classifier_preset),
    "voxel_classifier": (VoxelClassifier, voxel_classifier_preset),
}


def train_dynamics(
    data: Path, out: Path, preset: PresetName, epochs: int | None, seed: int, report: Report
) -> Header:
    """An ensemble of unconstrained dynamics, and the model-error requirement's threshold."""
    dataset = open_dataset(data)
    task = make_task(dataset.config["task"])
    if dataset.config.get("phase") != "unconstrained":
        raise ValueError(
            f"{data} holds data of phase {dataset.config.get('phase')!r}: unconstrained dynamics are learned "
            "from phase unconstrained"
        )
    chosen = _with_epochs(dynamics_preset(preset, task), epochs)
    run = open_run(out, "dynamics", task.name, chosen, seed, {"data": data / MANIFEST})
    train, validation = load_split(dataset, "train"), load_split(dataset, "validation")
    problem = DynamicsProblem(train, validation, chosen.network, preset != "thesis")
    members = fit(problem, chosen.fit, seed=seed, run=run, report=report)
    ensemble = Ensemble(members)
    config = {**asdict(chosen.network), "members": chosen.fit.members}
    about = {
        "preset": preset,
        "seed": seed,
        "threshold_m": error_threshold(ensemble, load_split(dataset, "calibration")),
        SAW: seen_data([dataset]),
    }
    header = Header("dynamics", task.name, config, about)
    run.finish(header, ensemble)
    return header


def train_full_dynamics(
    data: Sequence[Path], out: Path, preset: PresetName, epochs: int | None, seed: int, report: Report
) -> Header:
    """Dynamics that look at the obstacles, from data of both phases: as much as the other method sees."""
    datasets = [open_dataset(path) for path in data]
    task = make_task(datasets[0].config["task"])
    for path, dataset in zip(data, datasets, strict=True):
        if dataset.config["task"] != task.name:
            raise ValueError(f"{path} holds data of the task {dataset.config['task']!r}, not {task.name!r}")
    chosen = _with_epochs(full_dynamics_preset(preset, task), epochs)
    files = {f"data{i}": path / MANIFEST for i, path in enumerate(data)}
    run = open_run(out, "full_dynamics", task.name, chosen, seed, files)
    parts = {split: [load_split(one, split) for one in datasets] for split in ("train", "validation")}
    steps = min(part.actions.shape[1] for part in parts["train"])
    train, validation = (windows(part, steps) for part in parts.values())
    problem = DynamicsProblem(train, validation, chosen.network, True, FullDynamics, at_once=AT_ONCE)
    model = member(fit(problem, chosen.fit, seed=seed, run=run, report=report), 0)
    about = {"preset": preset, "seed": seed, SAW: seen_data(datasets)}
    header = Header("full_dynamics", task.name, asdict(chosen.network), about)
    run.finish(header, model)
    return header


def train_classifier(
    kind: ClassifierKind,
    data: Path,
    out: Path,
    dynamics: Path,
    preset: PresetName,
    epochs: int | None,
    seed: int,
    report: Report,
    *,
    threshold: float | None = None,
) -> Header:
    """A calibrated classifier, from distances or from voxels, and its conformal thresholds."""
    dataset, ensemble, task, threshold, judged = judged_data(data, dynamics, threshold)
    network, preset_of = CLASSIFIERS[kind]
    chosen = _with_epochs(preset_of(preset, task), epochs)
    labels = labels_preset(preset)
    files = {"data": data / MANIFEST, "dynamics": model_file(dynamics)}
    settings = {"threshold_m": threshold, "labels": asdict(labels)}
    run = open_run(out, kind, task.name, chosen, seed, files, **settings)
    splits = ("train", "validation", "calibration")
    parts = [load_split(dataset, split) for split in splits]
    train, validation, spare = (label(ensemble, part, labels) for part in parts)
    for split, examples in zip(splits, (train, validation, spare), strict=True):
        require_both_classes(examples, threshold, split)
    problem = ClassifierProblem(
        train, parts[0].obstacles, validation, parts[1].obstacles, network, chosen.network
    )
    models = fit(problem, chosen.fit, seed=seed, run=run, members=jnp.array([threshold]), report=report)
    model = member(models, 0)
    logits, right = judged_kept(model.logit, spare, parts[2].obstacles, threshold)
    calibration = fit_calibration(logits, right)
    model = eqx.tree_at(lambda m: m.calibration, model, calibration)
    probabilities = np.asarray(calibration(jnp.asarray(logits)))
    numbers = np.asarray(spare.trajectory)[np.asarray(spare.kept(threshold))]
    safe = {str(alpha): conformal_threshold(probabilities, right, alpha, numbers) for alpha in ALPHAS}
    about = {
        "preset": preset,
        "seed": seed,
        "threshold_m": threshold,
        "labels": asdict(labels),
        "conformal_thresholds": {a: value for a, value in safe.items() if np.isfinite(value)},
        SAW: seen_data([dataset], [judged]),
    }
    header = Header(kind, task.name, asdict(chosen.network), about)
    run.finish(header, model)
    return header


def train_deviation(
    data: Path,
    out: Path,
    dynamics: Path,
    preset: PresetName,
    epochs: int | None,
    seed: int,
    report: Report,
    *,
    threshold: float | None = None,
) -> Header:
    """A calibrated estimator of how far off predictions are, its limit, and factors to upper bounds."""
    dataset, ensemble, task, limit, judged = judged_data(data, dynamics, threshold)
    chosen = _with_epochs(deviation_preset(preset, task), epochs)
    per_norm = POURING_BIAS if isinstance(task.blank, PouringState) else BIAS
    bias = per_norm * float(np.sqrt(task.blank.passive))
    config = DeviationConfig(chosen.network, bias=bias, fit=chosen.fit)
    files = {"data": data / MANIFEST, "dynamics": model_file(dynamics)}
    settings = {"limit_m": limit, "horizon": config.horizon, "bias": bias}
    run = open_run(out, "deviation", task.name, chosen, seed, files, **settings)
    train, validation, spare = (
        deviation_examples(ensemble, load_split(dataset, split), horizon=config.horizon, kept_below=limit)
        for split in ("train", "validation", "calibration")
    )
    model = fit_deviation(train, validation, config, seed=seed, run=run, report=report)
    model, factors = calibrated(model, spare, ALPHAS)
    about = {
        "preset": preset,
        "seed": seed,
        "threshold_m": limit,
        "horizon": config.horizon,
        "conformal_factors": {str(alpha): value for alpha, value in factors.items() if np.isfinite(value)},
        SAW: seen_data([dataset], [judged]),
    }
    header = Header("deviation", task.name, asdict(chosen.network), about)
    run.finish(header, model.limited(limit))
    return header


def train_recovery(
    data: Path,
    out: Path,
    dynamics: Path,
    classifier: Path,
    preset: PresetName,
    epochs: int | None,
    seed: int,
    report: Report,
) -> Header:
    """A recovery network that begins with a classifier's encoder."""
    dataset, ensemble, task, _, judged = judged_data(data, dynamics, None)
    judge, begun = load_model(classifier, task=task.name, kind="classifier")
    chosen = _with_epochs(recovery_preset(preset, judge), epochs)
    files = {
        "data": data / MANIFEST,
        "dynamics": model_file(dynamics),
        "classifier": model_file(classifier),
    }
    run = open_run(out, "recovery", task.name, chosen, seed, files)
    train, validation = (
        label_recovery(
            task, ensemble, judge, load_split(dataset, split), key=stream(seed, "recovery labels", split)
        )
        for split in ("train", "validation")
    )
    if len(train) < FEWEST_RECOVERIES or len(validation) == 0:
        raise ValueError(
            f"{data} has {len(train)} training and {len(validation)} validation states where nothing is "
            f"accepted, expected at least {FEWEST_RECOVERIES} and 1: collect more data in scenes where the "
            "rope gets caught, or train a stricter classifier"
        )
    problem = RecoveryProblem(train, validation, judge, chosen.network)
    models = fit(problem, chosen.fit, seed=seed, run=run, report=report)
    model = member(models, 0)
    about = {"preset": preset, "seed": seed, "stuck_states": len(train)}
    about[SAW] = seen_data([dataset], [judged, begun])
    header = Header("recovery", task.name, asdict(chosen.network), about)
    run.finish(header, model)
    return header


def model_file(path: Path) -> Path:
    """A model's file, given it or the run that made it."""
    return path / MODEL if path.is_dir() else path


def judged_data(
    data: Path, dynamics: Path, threshold: float | None
) -> tuple[Dataset, Ensemble, Task, float, Header]:
    """Phase-two data, the dynamics whose predictions are compared with it, the task, the threshold (m) of
    their error, and the dynamics' header."""
    dataset = open_dataset(data)
    name = dataset.config["task"]
    if dataset.config.get("phase") != "constrained":
        raise ValueError(
            f"{data} holds data of phase {dataset.config.get('phase')!r}: where predictions hold is learned "
            "from phase constrained"
        )
    ensemble, header = load_model(dynamics, task=name, kind="dynamics")
    if threshold is None:
        threshold = own_threshold(header, dynamics)
    if not threshold > 0:
        raise ValueError(f"the threshold of the error is {threshold}, expected a positive length (m)")
    return dataset, ensemble, make_task(name), threshold, header


def _with_epochs(preset: Preset, epochs: int | None) -> Preset:
    if epochs is None:
        return preset
    return Preset(preset.network, replace(preset.fit, epochs=epochs))


def open_run(
    out: Path, what: str, task: str, preset: Preset, seed: int, files: dict[str, Path], **settings: Any
) -> RunDirectory:
    """A run's folder, with all that determines the result: ``files`` by their digests."""
    config = {
        "what": what,
        "task": task,
        "seed": seed,
        "network": asdict(preset.network),
        "fit": asdict(preset.fit),
        **{name: file_digest(path)[:16] for name, path in files.items()},
        **settings,
    }
    return RunDirectory.open(out, config)
