"""Training runs in the page: their curves, several over each other, and what they were made with."""

import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from doojax.learning.checkpoints import MODEL
from doojax.learning.runs import CONFIG, METRICS, RunDirectory
from doojax.reading import read_json
from doojax.viewer.page import Page
from doojax.viewer.plots import EpochPlot
from doojax.viewer.text import listed, plain, shortened

LOOK_AGAIN = 1.0  # s
MOST_BESIDE = 16
Curves = dict[str, Float[np.ndarray, "E K"]]  # by figure: one value an epoch and network


class RunPage:
    """The figures of one run, by epoch, and beside them those of others; they grow while training goes on.

    Raises ValueError for a run without epochs, or a damaged file, naming it.
    """

    def __init__(self, page: Page, run: RunDirectory, others: Sequence[Path] = ()):
        """Show the curves of all networks that were trained side by side.

        Args:
            page: where to.
            run: the one that is shown.
            others: folders of runs that may be shown over it.
        """
        self._page, self._run = page, run
        curves = curves_of(run)
        config = read_json(run.path / CONFIG, dict[str, Any], "the config of a run")
        if not curves:
            raise ValueError(f"{run.path} is empty: no epoch has been trained yet")
        gui = page.server.gui
        self._title = gui.add_markdown("")
        self._plots: dict[str, EpochPlot] = {}
        tabs = gui.add_tab_group()
        with tabs.add_tab("Curves"):
            self._plots = {name: EpochPlot(gui, name.replace("_", " ")) for name in curves}
        self._beside = {}
        if others:
            with tabs.add_tab("Beside"):
                for path in others[:MOST_BESIDE]:
                    box = gui.add_checkbox(shortened(relative(path, run.path), 26), initial_value=False)
                    box.on_update(page.calling(self._draw))
                    self._beside[path] = box
        with tabs.add_tab("About"):
            gui.add_markdown(listed(config))
        self._stopped = threading.Event()
        self._seen: tuple = ()
        self._draw()
        threading.Thread(target=self._watch, name="run", daemon=True).start()

    def close(self) -> None:
        """End what runs beside the page."""
        self._stopped.set()

    def go(self, wanted: Mapping[str, str]) -> None:
        """A run has but one place."""

    def _draw(self) -> None:
        shown = [path for path, box in self._beside.items() if box.value]
        self._seen = stamps([self._run.path, *shown])
        curves = curves_of(self._run)
        epochs = len(next(iter(curves.values()), ()))
        self._title.content = f"**training run, {epochs} epochs**  \n{plain(shortened(self._run.path))}"
        if self._run.finished:
            self._page.warning.visible = False
        else:
            text = f"unfinished: {epochs} epochs so far; the same train command goes on with it"
            self._page.warn(text, again=False)
        beside = {relative(path, self._run.path): curves_of(RunDirectory(path)) for path in shown}
        for name, plot in self._plots.items():
            values = curves.get(name, np.zeros((0, 1)))
            if not beside:
                plot.set({f"network {member}": each for member, each in enumerate(values.T)})
            else:  # of several runs, the mean of each one's networks
                others = {run: found[name].mean(1) for run, found in beside.items() if name in found}
                plot.set({self._run.path.name: values.mean(1), **others})

    def _watch(self) -> None:
        """Draw anew what has been trained since."""
        while not self._stopped.wait(LOOK_AGAIN):
            shown = [path for path, box in self._beside.items() if box.value]
            if stamps([self._run.path, *shown]) != self._seen:
                self._page.call(self._renew)

    def _renew(self) -> None:
        if not self._stopped.is_set():
            self._draw()


def curves_of(run: RunDirectory) -> Curves:
    """The figures of a run, one value an epoch and network; none before the first epoch.

    Raises ValueError for a damaged file, naming it. A line that is being written does not count.
    """
    epochs = run.metrics
    names = [name for name in epochs[0] if name != "epoch"] if epochs else []
    try:
        return {name: np.array([np.atleast_1d(e[name]) for e in epochs], float) for name in names}
    except ValueError as error:  # more networks in one epoch than in another
        raise ValueError(f"{run.path / METRICS} cannot be read: {error}") from error


def stamps(paths: Sequence[Path]) -> tuple:
    """What changes when a run goes on: the size of its figures, and whether its model is there."""

    def size(file: Path) -> int:
        return file.stat().st_size if file.exists() else -1

    return tuple((str(path), size(path / METRICS), size(path / MODEL)) for path in paths)


def relative(path: Path, to: Path) -> str:
    """What a run is called beside another: as much of its path as tells them apart."""
    shared = len(os.path.commonpath([path.absolute(), to.absolute()]).rstrip("/")) + 1
    return str(path.absolute())[shared:] or path.name
