"""What online runs came to: success by iteration, on held-out scenes and on the trials one learns from."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure
from rich.table import Column, Table

from doojax.experiments.online.runner import LEARNING, SECONDS, Seconds, evaluations
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import Estimate, bootstrap, success_rate
from doojax.experiments.reports.summary import row
from doojax.experiments.training.pictures import save_figure
from doojax.learning.runs import RunDirectory
from doojax.reading import read_lines

SEED = "seed_"  # and its number: the name of a seed's folder
WINDOW = 10  # iterations, over which success in training is averaged, or half as many as there are


@dataclass(frozen=True, eq=False)
class Curve:
    """One method's success, of the seeds that have come as far."""

    method: str
    seeds: tuple[int, ...]
    evaluated: Int[np.ndarray, "V"]  # after how many iterations
    held_out: Float[np.ndarray, "S V"]  # share of held-out goals reached
    trials: int  # of an evaluation
    training: Float[
        np.ndarray, "S I"
    ]  # share of an iteration's own goals reached; no column where none is learned
    seconds: Float[np.ndarray, "S I"]  # that an iteration took, its evaluation left out

    @property
    def stationary(self) -> bool:
        """Does it learn nothing?"""
        return self.training.shape[1] == 0


def read_curves(out: Path) -> list[Curve]:
    """The curves of all methods in a folder, up to what all seeds of each have done."""
    folders = sorted({path.parent.parent for path in out.glob(f"*/{SEED}*/{LEARNING}")})
    return [curve for curve in map(_curve, folders) if curve is not None]


def _curve(folder: Path) -> Curve | None:
    numbers = sorted(int(path.name.removeprefix(SEED)) for path in folder.glob(f"{SEED}*"))
    own = {seed: folder / f"{SEED}{seed}" for seed in numbers}
    found = {seed: evaluations(path) for seed, path in own.items()}
    seeds = tuple(seed for seed, some in found.items() if some)
    if not seeds:
        return None
    common = min(len(found[seed]) for seed in seeds)
    first = found[seeds[0]][:common]
    lines = {seed: RunDirectory(own[seed] / LEARNING).metrics for seed in seeds}
    done = min(len(lines[seed]) for seed in seeds)
    training = [[float(line["success_training"]) for line in lines[seed][:done]] for seed in seeds]  # type: ignore[arg-type]
    times = [_seconds(own[seed], done) for seed in seeds]
    return Curve(
        method=folder.name,
        seeds=seeds,
        evaluated=np.array([one.iteration for one in first]),
        held_out=np.array([[one.rate for one in found[seed][:common]] for seed in seeds]),
        trials=len(first[0].reached),
        training=np.array(training, float).reshape(len(seeds), done),
        seconds=np.array(times, float).reshape(len(seeds), done),
    )


def _seconds(folder: Path, done: int) -> list[float]:
    lines = read_lines(folder / SECONDS, Seconds, "how long an iteration took")
    by_iteration = {line.iteration: line.trials + line.learning for line in lines}
    return [by_iteration.get(iteration, 0.0) for iteration in range(1, done + 1)]


def over_seeds(values: Float[np.ndarray, "S"], trials: int) -> Estimate:
    """The mean over seeds; of one seed alone, Wilson's interval over its trials."""
    if len(values) > 1:
        return bootstrap(values)
    return success_rate(np.arange(trials) < round(float(values[0]) * trials))


def rows_of(task: str, curve: Curve) -> list[Row]:
    """Success after each evaluation, in training before it, and the seconds of an iteration."""
    rows = []
    for column, iteration in enumerate(curve.evaluated.tolist()):
        tags = {"task": task, "method": curve.method, "iteration": iteration}
        rate = over_seeds(curve.held_out[:, column], curve.trials)
        n = len(curve.seeds)
        rows.append(
            row("success_rate", tags | {"evaluation": "held_out"}, rate.value, "", rate.low, rate.high, n)
        )
        before = curve.evaluated[column - 1] if column else 0
        trained = curve.training[:, before:iteration]
        if trained.shape[1]:
            rate = bootstrap(trained.mean(1)) if n > 1 else bootstrap(trained.ravel())
            tags = tags | {"evaluation": "training"}
            rows.append(row("success_rate", tags, rate.value, "", rate.low, rate.high, n))
    if not curve.stationary:
        took = bootstrap(curve.seconds.ravel(), np.median)
        tags = {"task": task, "method": curve.method}
        rows.append(row("iteration_s", tags, took.value, "s", took.low, took.high, took.n))
    return rows


def table_of(task: str, curves: list[Curve]) -> Table:
    """One line a method: success at first and at last, and how long an iteration takes."""
    name = Column("method", no_wrap=True, min_width=max(len(curve.method) for curve in curves))
    table = Table(
        name,
        "seeds",
        "after",
        "at first",
        "now",
        "own trials",
        "seconds",
        title=f"{task}: goals reached in held-out scenes, and in own trials of {WINDOW} iterations",
    )
    for curve in curves:
        last = over_seeds(curve.held_out[:, -1], curve.trials)
        now = f"{last.value:.0%} ({last.low:.0%} to {last.high:.0%})"
        trained = "" if curve.stationary else f"{curve.training[:, -WINDOW:].mean():.0%}"
        took = "" if curve.stationary else f"{np.median(curve.seconds):.1f}"
        before = f"{curve.held_out[:, 0].mean():.0%}"
        done = str(curve.evaluated[-1])
        table.add_row(curve.method, str(len(curve.seeds)), done, before, now, trained, took)
    return table


def draw_success(out: Path, task: str, curves: list[Curve]) -> None:
    """Success against iterations: held out as lines with all seeds' range, in training as dots."""
    figure = Figure(figsize=(7.5, 4), dpi=100, layout="constrained")
    axis = figure.subplots()
    most = max((int(curve.evaluated[-1]) for curve in curves), default=0)
    for number, curve in enumerate(curves):
        colour = f"C{number % 10}"
        if curve.stationary:
            rate = 100 * float(curve.held_out[:, 0].mean())
            axis.axhline(rate, color=colour, linestyle="--", linewidth=1, label=curve.method)
            continue
        percent = 100 * curve.held_out
        axis.fill_between(
            curve.evaluated, percent.min(0), percent.max(0), color=colour, alpha=0.15, linewidth=0
        )
        axis.plot(
            curve.evaluated, percent.mean(0), color=colour, marker="o", markersize=3, label=curve.method
        )
        mean = 100 * curve.training.mean(0)
        width = min(WINDOW, -(-len(mean) // 2))
        if width:
            smooth = np.convolve(mean, np.ones(width) / width, mode="valid")
            axis.plot(np.arange(width, len(mean) + 1), smooth, color=colour, linestyle=":", linewidth=1)
    axis.set(
        xlabel="iterations", ylabel="goals reached, %", ylim=(-2, 102), xlim=(0, max(most, 1)), title=task
    )
    axis.grid(alpha=0.3)
    axis.legend(
        fontsize=8, loc="best", title="solid: held out; dotted: own trials, running mean", title_fontsize=7
    )
    save_figure(figure, out)
