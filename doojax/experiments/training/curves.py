"""Learning curves of a training run as a picture."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from doojax.experiments.training.pictures import save_figure
from doojax.learning.runs import RunDirectory


def draw_curves(run: Path, out: Path) -> None:
    """One panel a figure that was logged, one line a network.

    Args:
        run: a training run's folder.
        out: the PNG to write.

    Raises:
        ValueError: no epoch was logged.
    """
    epochs = RunDirectory(run).metrics
    if not epochs:
        raise ValueError(f"{run} has no curves: no epoch has been trained yet")
    names = [name for name in epochs[0] if name != "epoch"]
    figure = Figure(figsize=(4 * len(names), 3), dpi=100, layout="tight")
    axes = figure.subplots(1, len(names), squeeze=False)
    for axis, name in zip(axes[0], names, strict=True):
        values = np.array([np.atleast_1d(epoch[name]) for epoch in epochs])
        axis.plot([epoch["epoch"] for epoch in epochs], values, linewidth=1)
        if (values > 0).all() and values.max() > 3 * values.min():
            axis.set_yscale("log")
        axis.set(xlabel="epoch", title=name.replace("_", " "))
        axis.grid(alpha=0.3)
    save_figure(figure, out)
