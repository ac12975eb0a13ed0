"""A data set in the page: pick, filter, sort and compare its trajectories."""

from collections.abc import Mapping, Sequence

import numpy as np

from doojax.datasets import Dataset
from doojax.experiments.drawing import Colour, Drawing
from doojax.simulation.state import Fault
from doojax.types import Obstacles
from doojax.viewer import colours
from doojax.viewer.augmentation_view import AugmentationView
from doojax.viewer.columns import Columns, curves, shown_as
from doojax.viewer.draw import SceneDrawing
from doojax.viewer.episodes import Episode, episode, require_rope, title
from doojax.viewer.films import Film, film_of_trajectory
from doojax.viewer.page import Page
from doojax.viewer.player import Player
from doojax.viewer.plots import TimePlot
from doojax.viewer.selection import Selection
from doojax.viewer.show import show_episode
from doojax.viewer.sight import Sight
from doojax.viewer.text import legend, plain, shortened

ARRANGEMENTS = ("side by side", "overlaid")
MOST = len(colours.OVERLAY)  # trajectories at once
GAP = 0.2  # m between two that are side by side


class DatasetPage:
    """The controls and the scene of one data set.

    Raises ValueError for a data set without ropes or without a complete shard.
    """

    def __init__(self, page: Page, dataset: Dataset):
        """Show the first trajectory that can be read."""
        require_rope(dataset)
        self._page, self._dataset = page, dataset
        self._columns = Columns(dataset, page.report)
        self._shown: list[Episode] = []
        self._drawings: list[SceneDrawing] = []
        self._arranged: tuple = ()
        gui = page.server.gui
        if not dataset.complete:
            page.warn(
                f"unfinished: {len(dataset)} of {dataset.manifest.trajectories} trajectories so far; the "
                "same collect command goes on with it"
            )
        gui.add_markdown(f"**{plain(title(dataset))}**  \n{plain(shortened(dataset.path))}")
        self._selection = Selection(page, len(dataset), "trajectory", self._load)
        self.player = Player(page, self._show)
        self._facts = gui.add_markdown("")
        self._legend = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Curves"):
            self._plots = {name: TimePlot(gui, shown_as(name)[0]) for name in curves(dataset)}
        with tabs.add_tab("Filter and sort"):
            self._selection.add_controls(self._columns.names, self._columns.__getitem__, "trajectories")
        with tabs.add_tab("Compare"):
            self._at_once = gui.add_slider("Shown at once", min=1, max=MOST, step=1, initial_value=1)
            self._arrangement = gui.add_dropdown("Arrangement", ARRANGEMENTS)
            self._trail = gui.add_checkbox("Trail", initial_value=True, hint="Earlier ropes, grippers' ways")
            fit = gui.add_button("Fit view")
        self._augmentation = None
        if "verdict" in dataset.fields:
            with tabs.add_tab("Augmentation"):
                self._augmentation = AugmentationView(page, dataset, lambda: self._show(self.player.moment))
        with tabs.add_tab("View"):
            self._sight = Sight(page, self._obstacles, self._film, self._place)
        for control in (self._at_once, self._arrangement):
            control.on_update(page.calling(self._load))
        self._trail.on_update(page.calling(lambda: self._show(self.player.moment)))
        fit.on_click(page.calling(page.fit_view))
        page.call(self._load)

    def close(self) -> None:
        """End what runs beside the page."""
        self.player.stop()

    def go(self, wanted: Mapping[str, str]) -> None:
        """Go to where an address leads. Raises ValueError for numbers that are none."""
        if "trajectory" in wanted:
            self._selection.go_to(int(wanted["trajectory"]))
        if "state" in wanted:
            self.player.pause()
            self.player.go_to(float(wanted["state"]))

    def _first(self) -> int:
        if not len(self._selection.order):
            raise ValueError("no trajectory is shown")
        return int(self._selection.order[self._selection.place])

    def _place(self) -> dict[str, object]:
        return {"trajectory": self._first(), "state": int(self.player.moment)}

    def _obstacles(self) -> Sequence[tuple[Drawing, Obstacles]]:
        alone = self._arrangement.value == "overlaid"
        shown = zip(self._drawings, self._shown, strict=False)
        return [(drawing, one.obstacles) for drawing, one in shown][: 1 if alone else None]

    def _film(self) -> Film:
        return film_of_trajectory(self._dataset, self._first())

    def _load(self) -> None:
        """Read the trajectories that are to be shown, and arrange them."""
        first = self._selection.place
        chosen = self._selection.order[first : first + int(self._at_once.value)]
        self._shown = []  # should reading fail, nothing old is shown as if it were new
        if not len(chosen):
            self._clear()
            self._facts.content = "no trajectory passes the filter"
            return
        try:
            self._shown = [episode(self._dataset, int(index)) for index in chosen]
            values = {name: self._dataset[name][int(chosen[0])] for name in self._plots}
            description = self._describe(int(chosen[0]))
        except ValueError:
            self._shown = []
            self._clear()
            self._facts.content = f"trajectory {self._dataset.rows[chosen[0]]} cannot be read"
            raise
        self._page.quiet()
        if self._augmentation is not None:
            self._augmentation.load(int(chosen[0]))
        self._arrange()
        self._facts.content = description
        meanings: dict[str, Colour | str] = {"rope": colours.ROPE, "earlier": "time"}
        if self._shown[0].look.what == "body":
            meanings = {"body": colours.ROPE, "its way": colours.OBSTACLE}
        if len(self._shown) > 1:
            rows = self._dataset.rows[chosen]
            meanings = {f"{row}": colour for row, colour in zip(rows, colours.OVERLAY, strict=False)}
        if self._augmentation is not None:
            meanings |= {"what is beside it": colours.CHOSEN, "searched for": colours.PREDICTION}
        meanings |= {"gripper, its way": colours.GRIPPER}
        if self._shown[0].obstacles.kind.shape[0]:
            meanings |= {"obstacle": colours.OBSTACLE}
        self._legend.content = legend(meanings)
        for name, plot in self._plots.items():
            plot.set({name: shown_as(name)[1] * values[name]})
        self.player.set_states(max(len(one.points) for one in self._shown))
        self._show(self.player.moment)

    def _clear(self) -> None:
        for drawing in self._drawings:
            drawing.clear()

    def _arrange(self) -> None:
        """Give each trajectory a place of its own, or all the same."""
        self._clear()
        first = self._shown[0]
        corners = first.corners()
        low, high = corners.min(0), corners.max(0)
        pitch = (high - low)[:2] + GAP
        columns = int(np.ceil(np.sqrt(len(self._shown))))
        overlaid = self._arrangement.value == "overlaid"
        offsets = np.zeros((len(self._shown), 3))
        if not overlaid:
            row, column = np.divmod(np.arange(len(self._shown)), columns)
            offsets[:, 0], offsets[:, 1] = column * pitch[0], -row * pitch[1]
        scene = self._page.server.scene
        while len(self._drawings) < len(self._shown):
            self._drawings.append(SceneDrawing(scene, f"/shown{len(self._drawings)}"))
        for place, (drawing, one, offset) in enumerate(
            zip(self._drawings, self._shown, offsets, strict=False)
        ):
            scene.add_frame(f"/shown{place}", show_axes=False, position=offset)
            if place == 0 or not overlaid:
                self._sight.draw_one(drawing, one.obstacles)
        arranged = (len(self._shown), overlaid, first.planar)
        if arranged != self._arranged:
            self._arranged = arranged
            everywhere = (corners[None] + offsets[:, None].astype(np.float32)).reshape(-1, 3)
            self._page.stage(everywhere, first.look.floor, first.planar)

    def _show(self, moment: float) -> None:
        several = len(self._shown) > 1
        for place, (drawing, one) in enumerate(zip(self._drawings, self._shown, strict=False)):
            colour = colours.OVERLAY[place] if several else colours.ROPE
            show_episode(drawing, one, moment, colour=colour, trail=self._trail.value and not several)
        if self._augmentation is not None and self._shown:
            self._augmentation.show(self._drawings[0], self._shown[0].look, moment)
        for plot in self._plots.values():
            plot.mark(moment)

    def _describe(self, index: int) -> str:
        dataset = self._dataset
        lines = [f"trajectory **{dataset.rows[index]}**"]
        if "environment" in dataset.fields:
            lines[0] += f", environment {dataset['environment'][index]}"
        if "stretch" in dataset.fields:
            stretch = dataset["stretch"][index]
            lines.append(f"greatest stretch {np.max(stretch, where=stretch == stretch, initial=0):.2%}")
        if "clearance" in dataset.fields:
            clearance = dataset["clearance"][index]
            least = float(np.min(clearance, where=clearance == clearance, initial=np.inf))
            lines.append(f"least clearance {1000 * least:.1f} mm" if least < 10 else "no obstacles")
        if "faults" in dataset.fields:
            bits = dataset["faults"][index]
            where = np.flatnonzero(bits)
            if len(where):
                names = Fault(int(np.bitwise_or.reduce(bits))).name or "unknown"
                lines.append(f"**fault {names.replace('|', ', ')}** from state {where[0] + 1} on")
        return "  \n".join(lines)
