"""A prediction record in the page: what a model expected beside what happened."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from doojax.experiments.records import PredictionRecord
from doojax.viewer import colours
from doojax.viewer.episodes import Episode
from doojax.viewer.page import Page
from doojax.viewer.player import Player
from doojax.viewer.plots import TimePlot
from doojax.viewer.show import WORST_ERROR, show_grid_slice, show_prediction

LEGEND = f"""orange: what happened; violet: predicted  
points: error, blue 0 to red {100 * WORST_ERROR:.0f} cm"""


class PredictionPage:
    """The controls and the scene of one prediction record."""

    def __init__(self, page: Page, record: PredictionRecord, name: str):
        """Show the first prediction."""
        self._page, self._record = page, record
        with np.errstate(invalid="ignore"):
            self._errors = np.sqrt((record.errors() ** 2).mean(-1))  # P H1, root mean square over the points
        gui = page.server.gui
        count = len(record.start)
        gui.add_markdown(f"**{record.task.replace('_', ' ')} · predictions**  \n`{name}`")
        self._pick = gui.add_slider("Prediction", min=1, max=max(count, 2), step=1, initial_value=1)
        self.player = Player(page, self._show, "Steps ahead")
        self._facts = gui.add_markdown("")
        gui.add_markdown(LEGEND)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Curves"):
            self._error_plot = TimePlot(gui, "error, cm (RMS over the rope's points)")
            self._score_plots = {score: TimePlot(gui, score) for score in record.scores}
        if record.grid is not None:
            with tabs.add_tab("Model input"):
                self._slice = gui.add_checkbox(
                    "Slice", initial_value=True, hint="Signed distance, blue inside"
                )
                depth = record.grid.values.shape[3]
                self._layer = gui.add_slider(
                    "Layer", min=0, max=max(depth - 1, 1), step=1, initial_value=depth // 2
                )
                self._height = gui.add_markdown("")
            for control in (self._slice, self._layer):
                control.on_update(page.calling(self._show_slice))
        if record.about:
            with tabs.add_tab("About"):
                gui.add_markdown(listed(record.about))
        self._pick.on_update(page.calling(self._load))
        page.key("Next prediction", "arrowdown", lambda: self._go(1))
        page.key("Previous prediction", "arrowup", lambda: self._go(-1))
        shown = Episode(record.points, record.grippers, record.obstacles, record.look)
        page.drawing.obstacles("obstacles", record.obstacles, colour=colours.OBSTACLE)
        page.stage(shown.corners(), record.look.floor, shown.planar)
        page.call(self._load)

    def close(self) -> None:
        """End what runs beside the page."""
        self.player.stop()

    @property
    def _index(self) -> int:
        return min(int(self._pick.value), len(self._record.start)) - 1

    def _go(self, steps: int) -> None:
        self._pick.value = int(np.clip(self._pick.value + steps, 1, len(self._record.start)))

    def _load(self) -> None:
        record, index = self._record, self._index
        if index < 0:
            raise ValueError("the record holds no predictions")
        steps = np.flatnonzero(np.isfinite(record.predicted_points[index]).all((1, 2)))
        count = int(steps[-1]) + 1 if len(steps) else 1
        self._error_plot.set({"error": 100 * self._errors[index, :count]})
        for name, plot in self._score_plots.items():
            levels = {"threshold": record.thresholds[name]} if name in record.thresholds else {}
            plot.set({name: record.scores[name][index, :count]}, levels)
        self.player.set_states(count)
        if record.grid is not None:
            self._show_slice()
        self._show(self.player.moment)

    def _show(self, moment: float) -> None:
        record, index = self._record, self._index
        show_prediction(self._page.drawing, record, index, moment)
        for plot in (self._error_plot, *self._score_plots.values()):
            plot.mark(moment)
        step = int(moment)
        error = self._errors[index, step] if step < self._errors.shape[1] else np.nan
        lines = [f"from state **{record.start[index]}** of {len(record.points) - 1}, {step} steps ahead"]
        lines.append(
            f"error {100 * error:.1f} cm" if np.isfinite(error) else "what happened here is not known"
        )
        for name, values in record.scores.items():
            score = float(values[index, step]) if step < values.shape[1] else np.nan
            if np.isfinite(score):
                bound = record.thresholds.get(name)
                beside = "" if bound is None else f" (threshold {bound:.3g})"
                lines.append(f"{name} {score:.3g}{beside}")
        self._facts.content = "  \n".join(lines)

    def _show_slice(self) -> None:
        grid = self._record.grid
        if grid is None:
            return
        origin = grid.origin[self._index if len(grid.origin) > 1 else 0]
        height = float(origin[2] + grid.spacing * self._layer.value)
        self._height.content = f"at a height of {height:.3f} m"
        if self._slice.value:
            show_grid_slice(self._page.drawing, self._record, self._index, height)
        else:
            self._page.drawing.remove("slice")


def listed(about: Mapping[str, Any]) -> str:
    """Names and values as Markdown."""
    return "  \n".join(f"{name}: `{json.dumps(value)}`" for name, value in about.items())
