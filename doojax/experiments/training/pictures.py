"""Pictures of how good models are."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from doojax.learning.metrics import reliability_diagram


def draw_dynamics(out: Path, error: Float[np.ndarray, "K T N"], title: str) -> None:
    """Errors (m) by step, as quantiles over trajectories and points, and by point of the rope."""
    figure, left, right = _two_panels()
    steps = np.arange(1, error.shape[1] + 1)
    by_step = 100 * np.quantile(error, [0.1, 0.5, 0.9], axis=(0, 2))
    left.fill_between(steps, by_step[0], by_step[2], alpha=0.25, label="10 % to 90 %")
    left.plot(steps, by_step[1], label="median")
    left.plot(steps, 100 * error.mean((0, 2)), "--", label="mean")
    left.set(xlabel="steps predicted", ylabel="error of a point, cm", title=title)
    left.legend()
    right.bar(np.arange(error.shape[2]), 100 * error.mean((0, 1)))
    right.set(xlabel="point of the rope", ylabel="mean error, cm")
    save_figure(figure, out)


def draw_classifier(
    out: Path, probabilities: Float[np.ndarray, "n"], right: Bool[np.ndarray, "n"], title: str
) -> None:
    """A reliability diagram, and how probabilities are spread over right and wrong predictions."""
    figure, left, other = _two_panels()
    mean, true, share = reliability_diagram(probabilities, right)
    left.plot([0, 1], [0, 1], color="grey", linewidth=1)
    left.scatter(mean, true, s=20 + 400 * share)
    left.set(xlabel="probability given", ylabel="fraction right", title=title, xlim=(0, 1), ylim=(0, 1))
    bins = list(np.linspace(0, 1, 31))
    other.hist(
        [probabilities[right], probabilities[~right]], bins, label=["right", "wrong"], log=True, stacked=True
    )
    other.set(xlabel="probability given", ylabel="predictions")
    other.legend()
    save_figure(figure, out)


def draw_deviation(
    out: Path, predicted: Float[np.ndarray, "n"], true: Float[np.ndarray, "n"], limit: float, title: str
) -> None:
    """True deviations (m) against predicted ones, and their quantiles in bins of as many predictions each."""
    figure, left, right = _two_panels()
    least = 1e-4
    x, y = (100 * np.maximum(values, least) for values in (predicted, true))
    left.scatter(x, y, s=2, alpha=0.2)
    order = np.array_split(np.argsort(x), 12)
    middle = [np.median(x[part]) for part in order]
    low, half, high = np.transpose([np.quantile(y[part], [0.1, 0.5, 0.9]) for part in order])
    right.fill_between(middle, low, high, alpha=0.25, label="10 % to 90 %")
    right.plot(middle, half, label="median")
    for axis in (left, right):
        axis.axline((1, 1), slope=1, color="grey", linewidth=1)
        axis.axvline(100 * limit, color="black", linewidth=1, linestyle=":")
        axis.set(xscale="log", yscale="log", xlabel="predicted deviation, cm", ylabel="true deviation, cm")
    left.set(title=title)
    right.legend()
    save_figure(figure, out)


def save_figure(figure: Figure, out: Path) -> None:
    """Write a PNG, and the folder that it is in."""
    out.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_png(out)


def _two_panels() -> tuple[Figure, Axes, Axes]:
    figure = Figure(figsize=(9, 3.4), dpi=100, layout="constrained")
    left, right = figure.subplots(1, 2)
    return figure, left, right
