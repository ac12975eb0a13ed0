"""A prediction record in the page: what a model expected beside what happened."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from doojax.experiments.drawing import Drawing
from doojax.experiments.trials.records import PredictionRecord
from doojax.types import Obstacles
from doojax.viewer import colours
from doojax.viewer.episodes import episode_of
from doojax.viewer.films import Film, film_of_prediction
from doojax.viewer.page import Page
from doojax.viewer.player import Player
from doojax.viewer.plots import TimePlot
from doojax.viewer.selection import Selection
from doojax.viewer.show import WORST_ERROR, show_grid, show_prediction
from doojax.viewer.sight import Sight
from doojax.viewer.text import legend, listed, plain, shortened

LEGEND = {"rope, as it was": colours.ROPE, "as predicted": colours.PREDICTION, "gripper": colours.GRIPPER}
LEGEND |= {"obstacle": colours.OBSTACLE, f"error, 0 to {100 * WORST_ERROR:.0f} cm": "error"}
INPUTS = ("hidden", "one layer", "what obstacles fill")
WORST, ACCEPTS, REJECTS = "worst steps", "false accepts", "false rejects"
MOST_WORST = 20


class PredictionPage:
    """The controls and the scene of one prediction record.

    Raises ValueError for a record without predictions.
    """

    def __init__(self, page: Page, record: PredictionRecord, name: str):
        """Show the first prediction."""
        if not len(record.start):
            raise ValueError(f"{name} is empty: the record holds no predictions")
        self._page, self._record = page, record
        self._errors = 100 * record.rms_errors()  # P H1, cm
        self._mistakes = record.mistaken()
        self._places = places_of(record)
        self._trajectory = -1  # whose obstacles are drawn
        columns = self._columns()
        gui = page.server.gui
        gui.add_markdown(
            f"**{plain(record.task.replace('_', ' '))} · predictions**  \n{plain(shortened(name))}"
        )
        self._selection = Selection(page, len(record.start), "prediction", self._load)
        self.player = Player(page, self._show, "Steps ahead")
        kinds = [f"{kind} ({len(found)})" for kind, found in self._places.items()]
        self._kind = gui.add_dropdown("Go through", kinds, hint="Keys: N next, P previous")
        self._jumped = -1
        self._kind.on_update(page.calling(self._begin_places))
        page.key("Next of these", "N", lambda: self._go(1))
        page.key("Previous of these", "P", lambda: self._go(-1))
        self._facts = gui.add_markdown("")
        gui.add_html(legend(LEGEND))
        tabs = gui.add_tab_group()
        with tabs.add_tab("Curves"):
            self._error_plot = TimePlot(gui, "error, cm (RMS over the rope's points)")
            self._score_plots = {score: TimePlot(gui, score) for score in record.scores}
        with tabs.add_tab("Filter and sort"):
            self._selection.add_controls(tuple(columns), columns.__getitem__, "predictions")
        if record.grid is not None:
            with tabs.add_tab("Model input"):
                self._input = gui.add_dropdown("Input", INPUTS, initial_value=INPUTS[1])
                layers = record.grid.values.shape[3]
                self._layer = gui.add_slider("Layer", min=0, max=max(layers - 1, 1), step=1, initial_value=0)
                self._about_input = gui.add_markdown("")
                away = record.points[..., 2].mean() - record.grid.origin[0, 2]  # at the rope's height
                self._layer.value = int(np.clip(round(away / record.grid.spacing), 0, layers - 1))
            for control in (self._input, self._layer):
                control.on_update(page.calling(self._show_input))
        with tabs.add_tab("View"):
            self._sight = Sight(page, self._obstacles, self._film, self._place)
        if record.about:
            with tabs.add_tab("About"):
                gui.add_markdown(listed(record.about))
        page.stage(corners_of_predictions(record), record.look.floor, episode_of(record).planar)
        page.call(self._load)

    def close(self) -> None:
        """End what runs beside the page."""
        self.player.stop()

    def go(self, wanted: Mapping[str, str]) -> None:
        """Go to where an address leads. Raises ValueError for numbers that are none."""
        if "prediction" in wanted:
            self._selection.go_to(int(wanted["prediction"]))
        if "state" in wanted:
            self.player.pause()
            self.player.go_to(float(wanted["state"]))

    def _place(self) -> dict[str, object]:
        return {"prediction": self._index, "state": int(self.player.moment)}

    def _obstacles(self) -> list[tuple[Drawing, Obstacles]]:
        return [(self._page.drawing, self._record.obstacles_of(max(self._trajectory, 0)))]

    def _film(self) -> Film:
        return film_of_prediction(self._record, self._index)

    @property
    def _index(self) -> int:
        return int(self._selection.order[self._selection.place])

    def _columns(self) -> dict[str, Float[np.ndarray, "P"]]:
        """What predictions are filtered and sorted by: their errors, and bounds of their scores."""
        low, high = {}, {}
        for name, values in {"error, cm": self._errors, **self._record.scores}.items():
            known = np.isfinite(values)
            some = known.any(1)
            low[f"least {name}"] = np.where(some, np.min(values, 1, where=known, initial=np.inf), np.nan)
            high[f"greatest {name}"] = np.where(some, np.max(values, 1, where=known, initial=-np.inf), np.nan)
        del low["least error, cm"]  # that of the start
        return {**high, **low}

    def _load(self) -> None:
        record = self._record
        if not len(self._selection.order):
            self._page.drawing.remove("actual")
            self._page.drawing.remove("predicted")
            self._page.drawing.remove("input")
            self._facts.content = "no prediction passes the filter"
            return
        index = self._index
        if self._trajectory != record.trajectory(index):
            self._trajectory = record.trajectory(index)
            self._sight.draw()
        steps = np.flatnonzero(np.isfinite(record.predicted_points[index]).all((1, 2)))
        count = int(steps[-1]) + 1 if len(steps) else 1
        bound = {} if record.error_threshold is None else {"threshold": 100 * record.error_threshold}
        self._error_plot.set({"error": self._errors[index, :count]}, bound)
        for name, plot in self._score_plots.items():
            levels = {"threshold": record.thresholds[name]} if name in record.thresholds else {}
            plot.set({name: record.scores[name][index, :count]}, levels)
        self.player.set_states(count)
        self._show_input()
        self._show(self.player.moment)

    def _show(self, moment: float) -> None:
        if not len(self._selection.order):
            return
        record, index = self._record, self._index
        show_prediction(self._page.drawing, record, index, moment)
        for plot in (self._error_plot, *self._score_plots.values()):
            plot.mark(moment)
        step = min(int(moment), self._errors.shape[1] - 1)
        error = self._errors[index, step]
        states = record.states(record.trajectory(index))
        first, last = record.start[index] - states.start, states.stop - states.start - 1
        lines = [f"prediction **{index}**, from state {first} of {last}"]
        if record.rows is not None:
            lines[0] += f", trajectory {record.rows[record.trajectory(index)]}"
        known = f"error {error:.1f} cm" if np.isfinite(error) else "what happened here is not known"
        lines.append(f"{step} steps ahead: {known}")
        for name, values in record.scores.items():
            if np.isfinite(values[index, step]):
                bound = record.thresholds.get(name)
                beside = "" if bound is None else f" (threshold {bound:.3g})"
                lines.append(f"{plain(name)} {values[index, step]:.3g}{beside}")
        if record.accepted is not None and step > 0:
            lines.append(self._verdict(index, step))
        self._facts.content = "  \n".join(lines)

    def _verdict(self, index: int, step: int) -> str:
        """What the judge said of a step, and whether that was so."""
        accepted = self._record.accepted
        said = "accepted" if accepted is not None and accepted[index, step] else "rejected"
        accepts, rejects = self._mistakes
        if accepts[index, step]:
            return f"**{said}, but wrong: a false accept**"
        if rejects[index, step]:
            return f"**{said}, but right: a false reject**"
        counted = self._record.counted()[index, step]
        return said + ("" if counted else " (begins where the prediction was wrong already: not counted)")

    def _begin_places(self) -> None:
        self._jumped = -1
        self._go(1)

    def _go(self, steps: int) -> None:
        """Show the next or the previous of the steps that one goes through."""
        kind = list(self._places)[self._kind.options.index(self._kind.value)]
        places = self._places[kind]
        if not len(places):
            self._page.report(f"there are no {kind}")
            return
        self._page.quiet()
        self._jumped = int(np.clip(self._jumped + steps, 0, len(places) - 1))
        prediction, step = places[self._jumped].tolist()
        self.player.pause()
        self._selection.go_to(prediction)
        self.player.go_to(float(step))

    def _show_input(self) -> None:
        record, grid = self._record, self._record.grid
        if grid is None or not len(self._selection.order):
            return
        index, layered = self._index, self._input.value == INPUTS[1]
        self._layer.visible = layered
        height = grid.origin[index if len(grid.origin) > 1 else 0, 2] + grid.spacing * self._layer.value
        what = "signed distance" if grid.kind == "distance" else "occupancy"
        self._about_input.content = f"{what}, height {height:.3f} m: blue inside" if layered else what
        if self._input.value == INPUTS[0]:
            self._page.drawing.remove("input")
        else:
            show_grid(self._page.drawing, record, index, int(self._layer.value) if layered else None)


def corners_of_predictions(record: PredictionRecord) -> Float[np.ndarray, "K 3"]:
    """Corners (m) of a box around all that happened, and of predictions what is within half its width."""
    worlds = [episode_of(record, trajectory).corners() for trajectory in range(len(record.begins))]
    low = np.min([world.min(0) for world in worlds], axis=0)
    high = np.max([world.max(0) for world in worlds], axis=0)
    room = (high - low).max() / 2
    predicted = record.predicted_points.reshape(-1, 3)
    predicted = predicted[np.isfinite(predicted).all(-1)].clip(low - room, high + room)
    everything = np.concatenate([low[None], high[None], predicted])
    low, high = everything.min(0), everything.max(0)
    return np.stack(np.meshgrid(*np.stack([low, high], -1)), -1).reshape(-1, 3).astype(np.float32)


def places_of(record: PredictionRecord) -> dict[str, Int[np.ndarray, "k 2"]]:
    """Predictions and steps worth a look: the worst of each prediction, then what the judge was wrong about.

    The worst first: by the error; of false rejects, the least error.
    """
    error = np.nan_to_num(record.rms_errors(), nan=-1.0)
    worst = np.stack([np.arange(len(error)), error.argmax(1)], axis=1)
    order = np.argsort(-error.max(1), kind="stable")[:MOST_WORST]
    found = {WORST: worst[order]}
    if record.accepted is not None and record.error_threshold is not None:
        for name, chosen, sign in zip((ACCEPTS, REJECTS), record.mistaken(), (-1, 1), strict=True):
            places = np.argwhere(chosen)
            found[name] = places[np.argsort(sign * error[chosen], kind="stable")]
    return found
