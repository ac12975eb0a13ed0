"""Train models: `doojax train`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from doojax.commands import command_line
from doojax.datasets.progress import progress_bar
from doojax.experiments.reports.provenance import digests, note_command
from doojax.experiments.training.curves import draw_curves
from doojax.files import alone_in
from doojax.keys import check_seed
from doojax.learning import train as learning
from doojax.learning.fit import Report
from doojax.learning.presets import PresetName

What = Literal["dynamics", "classifier", "voxel_classifier", "deviation", "recovery", "full_dynamics"]
JUDGES = ("classifier", "voxel_classifier", "deviation")  # whose threshold can be chosen
CURVES = "curves.png"


def train(
    what: What,
    /,
    *,
    data: tuple[Path, ...],
    out: Path,
    dynamics: Path | None = None,
    classifier: Path | None = None,
    preset: PresetName = "quick",
    epochs: int | None = None,
    threshold: float | None = None,
    seed: int = 0,
) -> None:
    """Train a model into a run's folder: metrics, checkpoints, learning curves and at the end model.eqx.

    A run that was killed goes on where it was when the same command is given again, to the same weights.

    Args:
        what: dynamics (an ensemble, from data of phase unconstrained), classifier (from distances, phase
            constrained), voxel_classifier (the thesis's), deviation (how far off predictions are, phase
            constrained), recovery, or full_dynamics (data of both phases).
        data: the data set's folder; two of them for full_dynamics.
        out: the run's folder; new, empty, or the same run unfinished.
        dynamics: the run or model.eqx whose predictions a classifier, a deviation estimator or a recovery
            network judges.
        classifier: the run or model.eqx of the classifier that a recovery network begins with.
        preset: quick (two CPU cores) or thesis (the thesis's sizes and choices).
        epochs: in place of the preset's.
        threshold: of the model error (m) below which a prediction counts as right, or below which a deviation
            is accepted; by default the 90 % quantile that was found when the dynamics were trained.
        seed: of everything that is random.

    Raises:
        ValueError: for data of another task or phase, too few of them or of one class, a model that is
            missing or does not fit, a folder that holds something else, or a loss that is not finite.
    """
    check_seed(seed)
    if threshold is not None and what not in JUDGES:
        raise ValueError(f"threshold is {threshold}, but {what} has none: it is a classifier's")
    if len(data) != (2 if what == "full_dynamics" else 1):
        wanted = "two data sets, one of each phase" if what == "full_dynamics" else "one data set"
        raise ValueError(f"{what} learns from {wanted}; {len(data)} were named")
    command = command_line(train, locals())
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    with alone_in(out), training_progress(console, what) as report:
        common: dict[str, Any] = {"preset": preset, "epochs": epochs, "seed": seed, "report": report}
        if what == "dynamics":
            header = learning.train_dynamics(data[0], out, **common)
        elif what == "full_dynamics":
            header = learning.train_full_dynamics(data, out, **common)
        elif what == "recovery":
            judged = _named(dynamics, "a recovery judges predictions: name the dynamics' run by --dynamics")
            begun = _named(classifier, "a recovery begins with a classifier: name its run by --classifier")
            header = learning.train_recovery(data[0], out, judged, begun, **common)
        else:
            judged = _named(dynamics, f"a {what} judges predictions: name the dynamics' run by --dynamics")
            common |= {"threshold": threshold}
            if what == "deviation":
                header = learning.train_deviation(data[0], out, judged, **common)
            else:
                header = learning.train_classifier(what, data[0], out, judged, **common)
    draw_curves(out, out / CURVES)
    files = {f"data {number}": path for number, path in enumerate(data, start=1)}
    inputs = {**files, "dynamics": dynamics, "classifier": classifier}
    note_command(out, command, seed, digests(inputs))
    for name, value in header.about.items():
        console.print(f"{name}: {value}")
    console.print(f"{out / 'model.eqx'} and {out / CURVES} are written")


def _named(path: Path | None, otherwise: str) -> Path:
    if path is None:
        raise ValueError(otherwise)
    return path


@contextmanager
def training_progress(console: Console, what: str) -> Iterator[Report]:
    """A bar with an epoch's figures, means over members; the context's value is to be told of each epoch."""
    with progress_bar(console) as progress:
        bar = progress.add_task(what, total=None, note="preparing")

        def report(number: int, total: int, metrics: dict[str, np.ndarray]) -> None:
            shown = "  ".join(f"{name} {values.mean():.4g}" for name, values in metrics.items())
            progress.update(bar, completed=number, total=total, note=shown)

        yield report
