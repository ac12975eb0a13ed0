"""How much hangs on the threshold of the model error: `doojax sweep-threshold`."""

import csv
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from scipy import stats

from doojax.commands import command_line
from doojax.experiments.reports.provenance import digests, note_command
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.experiments.training.pictures import save_figure
from doojax.experiments.training.train import training_progress
from doojax.files import alone_in
from doojax.keys import check_seed
from doojax.learning.presets import PresetName
from doojax.learning.sweep import Measured, sweep_thresholds

FIGURES = ("right_fraction", "accuracy", "precision", "recall", "auroc")
TABLE, PICTURE = "sweep.csv", "sweep.png"


def sweep_threshold(
    *,
    data: Path,
    dynamics: Path,
    out: Path,
    thresholds: tuple[float, ...] = (),
    seeds: int = 3,
    epochs: int = 3,
    trajectories: int = 256,
    preset: PresetName = "quick",
    seed: int = 0,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Train classifiers from distances for several thresholds and seeds in one run, and measure them.

    Each is measured on the test split by the labels of its own threshold. Writes sweep.csv and sweep.png; a
    sweep that was killed goes on where it was when the same command is given again.

    Args:
        data: a data set of phase constrained.
        dynamics: the run or model.eqx whose predictions are judged.
        out: the sweep's folder; new, empty, or the same sweep unfinished.
        thresholds: of the model error (m) below which a prediction counts as right; by default 0.5, 0.75,
            1, 1.5 and 2 times the dynamics' own.
        seeds: classifiers for each threshold.
        epochs: of training.
        trajectories: of all splits but test, at most: few, as there are many classifiers.
        preset: quick or thesis, of the network and the labels.
        seed: of everything that is random.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/where_to_trust; by
            default they are only shown.

    Raises:
        ValueError: for data of another task or phase, or a threshold for which a split has too few examples
            of a class.
    """
    check_seed(seed)
    command = command_line(sweep_threshold, locals())
    with alone_in(out), training_progress(Console(stderr=True), "sweep") as report:
        task, own, measured = sweep_thresholds(
            data, out, dynamics, thresholds, seeds, preset, epochs, trajectories, seed, report
        )
    with (out / TABLE).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Measured)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(one) for one in measured)
    draw_sweep(out / PICTURE, measured, own, task)
    rows = sweep_rows(measured, {"task": task, "model": "classifier", "preset": preset}, own)
    inputs = digests({"data": data, "dynamics": dynamics})
    note_command(out, command, seed, inputs)
    publish_rows(publish, command=command, seed=seed, rows=rows, inputs=inputs)
    show(rows, json)


def sweep_rows(measured: Sequence[Measured], tags: dict[str, str], own: float) -> list[Row]:
    """The mean over seeds of each figure at each threshold, with its t interval, cut off at 0 and 1.

    A threshold is named by how many times the dynamics' own, ``own`` (m), it is.
    """
    rows = []
    for threshold in sorted({one.threshold_m for one in measured}):
        named = tags | {"times_own": round(threshold / own, 3)}
        rows.append(row("threshold_sweep_threshold_m", named, threshold, "m"))
        for name in FIGURES:
            values = np.array([getattr(one, name) for one in measured if one.threshold_m == threshold])
            if np.isnan(values).any():  # precision where nothing is accepted
                continue
            low = high = None
            if name != "right_fraction" and len(values) > 1:
                half = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
                low, high = max(values.mean() - half, 0.0), min(values.mean() + half, 1.0)
            rows.append(row(f"threshold_sweep_{name}", named, values.mean(), "", low, high, len(values)))
    return rows


def draw_sweep(out: Path, measured: Sequence[Measured], own: float, task: str) -> None:
    """Each figure against the threshold: the mean over seeds as a line, every seed as a dot."""
    figure = Figure(figsize=(9, 3.6), dpi=100, layout="constrained")
    left, other = figure.subplots(1, 2)
    thresholds = sorted({one.threshold_m for one in measured})
    for axis, names in ((left, ("accuracy", "precision", "recall")), (other, ("auroc", "right_fraction"))):
        for number, name in enumerate(names):
            values = [[getattr(m, name) for m in measured if m.threshold_m == t] for t in thresholds]
            colour = f"C{number if axis is left else number + 3}"
            label = {"auroc": "AUROC", "right_fraction": "fraction right"}.get(name, name)
            axis.plot(100 * np.array(thresholds), np.mean(values, axis=1), color=colour, label=label)
            places = 100 * np.repeat(thresholds, [len(some) for some in values])
            axis.scatter(places, np.concatenate(values), s=12, color=colour, alpha=0.6)
        axis.axvline(100 * own, color="grey", linestyle="--", linewidth=1, label="the dynamics' own")
        axis.set(xlabel="threshold of the model error, cm")
        axis.grid(alpha=0.3)
        axis.legend()
    left.set(ylabel="on the test split", title=f"{task}, classifier")
    save_figure(figure, out)
