"""A training run in the page: its curves, and what it was made with."""

from typing import Any

import numpy as np

from doojax.learning.runs import CONFIG, METRICS, RunDirectory
from doojax.reading import read_json
from doojax.viewer.page import Page
from doojax.viewer.plots import add_epoch_plot
from doojax.viewer.text import listed, plain


class RunPage:
    """The figures of one run, by epoch.

    Raises ValueError for a run without epochs, or a damaged file, naming it.
    """

    def __init__(self, page: Page, run: RunDirectory):
        """Show the curves of all networks that were trained side by side."""
        epochs = run.metrics
        config = read_json(run.path / CONFIG, dict[str, Any], "the config of a run")
        names = [name for name in epochs[0] if name != "epoch"] if epochs else []
        try:
            curves = {name: np.array([np.atleast_1d(e[name]) for e in epochs], float) for name in names}
        except ValueError as error:  # more networks in one epoch than in another
            raise ValueError(f"{run.path / METRICS} cannot be read: {error}") from error
        if not epochs:
            raise ValueError(f"{run.path} is empty: no epoch has been trained yet")
        if not run.finished:
            page.warn(f"unfinished: {len(epochs)} epochs so far; the same train command goes on with it")
        gui = page.server.gui
        gui.add_markdown(f"**training run, {len(epochs)} epochs**  \n{plain(run.path)}")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Curves"):
            for name, values in curves.items():
                members = {f"network {member}": each for member, each in enumerate(values.T)}
                add_epoch_plot(gui, name.replace("_", " "), members)
        with tabs.add_tab("About"):
            gui.add_markdown(listed(config))

    def close(self) -> None:
        """Nothing runs beside the page."""
