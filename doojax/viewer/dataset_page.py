"""A data set in the page: pick, filter, sort and compare its trajectories."""

import numpy as np

from doojax.datasets import Dataset
from doojax.simulation.state import Fault
from doojax.viewer import colours
from doojax.viewer.columns import Columns, select
from doojax.viewer.draw import SceneDrawing
from doojax.viewer.episodes import Episode, episode, require_rope
from doojax.viewer.page import Page
from doojax.viewer.pictures import title
from doojax.viewer.player import Player
from doojax.viewer.plots import Histogram, TimePlot
from doojax.viewer.show import show_episode

NO_COLUMN = "(none)"
ORDERS = ("as stored", "ascending", "descending")
ARRANGEMENTS = ("side by side", "overlaid")
MOST = 9  # trajectories at once
GAP = 0.3  # m between two that are side by side
CURVES = {"stretch": ("stretch, %", 100.0), "clearance": ("clearance, mm", 1000.0)}  # title, factor


class DatasetPage:
    """The controls and the scene of one data set.

    Raises ValueError for a data set without ropes or without a complete shard.
    """

    def __init__(self, page: Page, dataset: Dataset):
        """Show the first trajectory that can be read."""
        require_rope(dataset)
        self._page, self._dataset = page, dataset
        self._columns = Columns(dataset, page.report)
        self._order = np.arange(len(dataset))
        self._shown: list[Episode] = []
        self._drawings: list[SceneDrawing] = []
        self._arranged: tuple = ()
        gui = page.server.gui
        gui.add_markdown(f"**{title(dataset)}**  \n`{dataset.path}`")
        self._pick = gui.add_slider("Trajectory", min=1, max=max(len(dataset), 2), step=1, initial_value=1)
        self.player = Player(page, self._show)
        self._facts = gui.add_markdown("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Curves"):
            self._plots = {name: TimePlot(gui, CURVES[name][0]) for name in CURVES if name in dataset.fields}
        with tabs.add_tab("Filter and sort"):
            self._column = gui.add_dropdown("By", (NO_COLUMN, *self._columns.names))
            self._low = gui.add_number("From", 0.0, disabled=True)
            self._high = gui.add_number("To", 0.0, disabled=True)
            self._sort = gui.add_dropdown("Order", ORDERS, disabled=True)
            self._count = gui.add_markdown("")
            self._histogram = Histogram(gui)
        with tabs.add_tab("Compare"):
            self._at_once = gui.add_slider("Shown at once", min=1, max=MOST, step=1, initial_value=1)
            self._arrangement = gui.add_dropdown("Arrangement", ARRANGEMENTS)
            self._trail = gui.add_checkbox("Trail", initial_value=True, hint="Earlier ropes, grippers' ways")
            fit = gui.add_button("Fit view")
        self._pick.on_update(page.calling(self._load))
        self._column.on_update(page.calling(self._column_chosen))
        for control in (self._low, self._high, self._sort):
            control.on_update(page.calling(self._select))
        for control in (self._at_once, self._arrangement):
            control.on_update(page.calling(self._load))
        self._trail.on_update(page.calling(lambda: self._show(self.player.moment)))
        fit.on_click(page.calling(page.fit_view))
        page.key("Next trajectory", "arrowdown", lambda: self._go(1))
        page.key("Previous trajectory", "arrowup", lambda: self._go(-1))
        self._say_count()
        page.call(self._load)

    def close(self) -> None:
        """End what runs beside the page."""
        self.player.stop()

    def _go(self, steps: int) -> None:
        self._pick.value = int(np.clip(self._pick.value + steps, 1, max(len(self._order), 1)))

    def _column_chosen(self) -> None:
        name = self._column.value
        off = name == NO_COLUMN
        for control in (self._low, self._high, self._sort):
            control.disabled = off
        if not off:
            values = self._columns[name]
            finite = values[np.isfinite(values)]
            bounds = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
            self._low.value, self._high.value = bounds
        self._select()

    def _select(self) -> None:
        name = self._column.value
        if name == NO_COLUMN:
            self._order = np.arange(len(self._dataset))
            self._histogram.set("", np.zeros(0), np.zeros(0))
        else:
            values = self._columns[name]
            self._order = select(values, float(self._low.value), float(self._high.value), self._sort.value)
            self._histogram.set(name, values, values[self._order])
        self._say_count()
        self._pick.max = max(len(self._order), 2)
        if self._pick.value == 1:
            self._load()
        else:
            self._pick.value = 1

    def _say_count(self) -> None:
        dataset = self._dataset
        text = f"{len(self._order)} of {len(dataset)} trajectories"
        if not dataset.complete:
            wanted = dataset.manifest.trajectories
            text += f"  \n**unfinished**: {wanted} are wanted; the same collect command goes on with it"
        self._count.content = text

    def _load(self) -> None:
        """Read the trajectories that are to be shown, and arrange them."""
        first = min(self._pick.value, len(self._order)) - 1
        chosen = self._order[max(first, 0) : first + int(self._at_once.value)]
        if not len(chosen):
            self._clear()
            self._facts.content = "no trajectory passes the filter"
            return
        self._shown = []  # should reading fail, nothing old is shown as if it were new
        try:
            self._shown = [episode(self._dataset, int(index)) for index in chosen]
        except ValueError:
            self._clear()
            self._facts.content = f"trajectory {self._dataset.rows[chosen[0]]} cannot be read"
            raise
        self._page.quiet()
        self._arrange()
        self._facts.content = self._describe(int(chosen[0]))
        for name, plot in self._plots.items():
            plot.set({name: CURVES[name][1] * self._dataset[name][int(chosen[0])]})
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
            root = f"/shown{len(self._drawings)}"
            scene.add_frame(root, show_axes=False)
            self._drawings.append(SceneDrawing(scene, root))
        for place, (drawing, one, offset) in enumerate(
            zip(self._drawings, self._shown, offsets, strict=False)
        ):
            scene.add_frame(f"/shown{place}", show_axes=False, position=offset)
            if place == 0 or not overlaid:
                drawing.obstacles("obstacles", one.obstacles, colour=colours.OBSTACLE)
        arranged = (len(self._shown), overlaid, first.planar)
        if arranged != self._arranged:
            self._arranged = arranged
            everywhere = (corners[None] + offsets[:, None].astype(np.float32)).reshape(-1, 3)
            self._page.stage(everywhere, first.look.floor, first.planar)

    def _show(self, moment: float) -> None:
        several = len(self._shown) > 1
        for place, (drawing, one) in enumerate(zip(self._drawings, self._shown, strict=False)):
            colour = colours.OVERLAY[place % len(colours.OVERLAY)] if several else colours.ROPE
            show_episode(drawing, one, moment, colour=colour, trail=self._trail.value and not several)
        for plot in self._plots.values():
            plot.mark(moment)

    def _describe(self, index: int) -> str:
        dataset = self._dataset
        lines = [f"trajectory **{dataset.rows[index]}**"]
        if "environment" in dataset.fields:
            lines[0] += f", environment {dataset['environment'][index]}"
        if "stretch" in dataset.fields:
            lines.append(f"greatest stretch {np.nanmax(dataset['stretch'][index]):.2%}")
        if "clearance" in dataset.fields:
            least = float(np.nanmin(dataset["clearance"][index]))
            lines.append(f"least clearance {1000 * least:.1f} mm" if least < 10 else "no obstacles")
        if "faults" in dataset.fields:
            bits = dataset["faults"][index]
            where = np.flatnonzero(bits)
            if len(where):
                names = Fault(int(np.bitwise_or.reduce(bits))).name or "unknown"
                lines.append(f"**fault {names.replace('|', ', ')}** from state {where[0] + 1} on")
        return "  \n".join(lines)
