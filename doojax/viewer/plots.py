"""Plots in the page."""

from collections.abc import Mapping, Sequence

import numpy as np
import viser
import viser.uplot
from jaxtyping import Float
from matplotlib.ticker import LogLocator, MaxNLocator

from doojax.experiments.drawing import Colour
from doojax.viewer import colours

HEIGHT, PADDING = 150, (10, 14, 0, 0)  # pixels
BINS = 24
MOST_TICKS = 5
WHOLE = tuple(float(digit * 10**power) for power in range(6) for digit in (1, 2, 5))
MARKS: dict[str, Colour] = {"search": colours.CHOSEN, "recovery": colours.RECOVERY}
MARKS |= {"accepted": colours.GOAL, "accepted by luck": colours.REJECTED}
LINES: tuple[Colour, ...] = (colours.ROPE, colours.CHOSEN, colours.GOAL, colours.PREDICTION)
LINES += tuple(colour for colour in colours.OVERLAY if colour not in LINES)


class TimePlot:
    """Curves over the states of what is shown, with a mark at the present moment once `mark` has set it."""

    def __init__(self, gui: viser.GuiApi, title: str):
        """An empty plot in the page's current folder."""
        self._gui, self._title = gui, title
        self._folder = gui.add_folder(None)
        self._handle: viser.GuiUplotHandle | None = None
        self._names: tuple[str, ...] = ()
        self._marked = -1

    def set(
        self,
        curves: Mapping[str, Float[np.ndarray, "T1"]],
        levels: Mapping[str, float] | None = None,
        marks: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        """Show other curves, one value a state.

        Args:
            curves: by name.
            levels: heights of horizontal lines, by name.
            marks: states that are marked with dots on the first curve, by name.
        """
        levels, marks = levels or {}, marks or {}
        count = max((len(values) for values in curves.values()), default=0)
        lines = {name: np.asarray(values, dtype=float) for name, values in curves.items()}
        lines |= {name: np.full(count, height) for name, height in levels.items()}
        finite = [values[np.isfinite(values)] for values in lines.values()]
        everything = np.concatenate(finite) if finite else np.zeros(0)
        if count < 2 or not everything.size:
            self._drop()
            return
        low, high = float(everything.min()), float(everything.max())
        room = 0.05 * (high - low) or 0.5
        self._bounds = low - room, high + room
        first = np.nan_to_num(next(iter(lines.values())), nan=low - room / 2)
        for name, states in marks.items():
            lines[name] = np.full(count, np.nan)
            lines[name][list(states)] = first[list(states)]
        self._data = (np.arange(count, dtype=float), *lines.values())
        self._marked = -1
        if self._handle is not None and self._names == tuple(lines):
            self._handle.scales = self._scales()
            self._handle.axes = ({}, axis(*self._bounds))
            self._handle.data = self._with_mark(-1)
            return
        self._drop()
        self._names = tuple(lines)
        series = [
            _dots(name) if name in marks else _line(name, index, name in levels)
            for index, name in enumerate(lines)
        ]
        now = viser.uplot.Series(label="now", stroke=_css(colours.INK), width=1, points={"show": False})
        with self._folder:
            self._handle = self._gui.add_uplot(
                self._with_mark(-1),
                (viser.uplot.Series(label="state"), *series, now),
                title=self._title,
                scales=self._scales(),
                axes=({}, axis(*self._bounds)),
                height=HEIGHT,
                legend={"show": len(lines) > 1, "live": False},
                padding=PADDING,
            )

    def mark(self, moment: float) -> None:
        """Move the mark to the state before a moment."""
        state = int(moment)
        if self._handle is not None and state != self._marked:
            self._marked = state
            self._handle.data = self._with_mark(state)

    def _with_mark(self, state: int) -> tuple[Float[np.ndarray, "K"], ...]:
        """The curves with two more points at ``state``, where the mark leaves the bottom and comes back.

        -1 stands for no mark.
        """
        states, *lines = self._data
        at = int(np.clip(state, 0, len(states) - 1))
        low, high = self._bounds
        mark = np.full(len(states) + 2, low if state >= 0 else np.nan)
        if state >= 0:
            mark[at + 1] = high
        return (*(np.insert(line, at, [line[at]] * 2) for line in (states, *lines)), mark)

    def _scales(self) -> dict[str, viser.uplot.Scale]:
        return {"x": viser.uplot.Scale(time=False), "y": viser.uplot.Scale(range=self._bounds)}

    def _drop(self) -> None:
        if self._handle is not None:
            self._handle.remove()
            self._handle = None
        self._names = ()


class EpochPlot:
    """Curves with one value an epoch, of logarithmic height where all values are positive."""

    def __init__(self, gui: viser.GuiApi, title: str):
        """An empty plot in the page's current folder."""
        self._gui, self._title = gui, title
        self._folder = gui.add_folder(None)
        self._handle: viser.GuiUplotHandle | None = None
        self._about: tuple = ()  # what a plot cannot change

    def set(self, curves: Mapping[str, Float[np.ndarray, "_"]]) -> None:
        """Show other curves, or more of them; they may be of different lengths."""
        count = max((len(values) for values in curves.values()), default=0)
        lines = [
            np.pad(np.asarray(values, dtype=float), (0, count - len(values)), constant_values=np.nan)
            for values in curves.values()
        ]
        known = np.concatenate([line[np.isfinite(line)] for line in lines])
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
        logarithmic = low > 0
        room = 0.05 * (high - low) or 0.5
        low, high = (0.9 * low, 1.1 * high) if logarithmic else (low - room, high + room)
        data = (np.arange(count, dtype=float) + 1, *lines)
        scales: dict[str, viser.uplot.Scale] = {
            "x": viser.uplot.Scale(time=False),
            "y": viser.uplot.Scale(distr=3 if logarithmic else 1, range=(low, high)),
        }
        axes = (viser.uplot.Axis(incrs=WHOLE), axis(low, high, logarithmic))
        about = (tuple(curves), logarithmic)
        if self._handle is not None and about == self._about:
            self._handle.scales, self._handle.axes, self._handle.data = scales, axes, data
            return
        if self._handle is not None:
            self._handle.remove()
        self._about = about
        with self._folder:
            self._handle = self._gui.add_uplot(
                data,
                (viser.uplot.Series(label="epoch"), *(_line(name, i) for i, name in enumerate(curves))),
                title=self._title,
                scales=scales,
                axes=axes,
                height=HEIGHT,
                legend={"show": len(lines) > 1, "live": False},
                padding=PADDING,
            )


def axis(low: float, high: float, logarithmic: bool = False) -> viser.uplot.Axis:
    """Some round numbers from ``low`` to ``high``, written so that each can be told from the next.

    The page itself would round to three decimals, and write 0 for 0.0001.
    """
    locators = [LogLocator(), LogLocator(subs=(1, 2, 5))] if logarithmic else []
    places = np.zeros(0)
    for locator in [*locators, MaxNLocator(nbins=5, steps=[1, 2, 5, 10])]:
        places = np.asarray(locator.tick_values(low, high))
        places = places[(low <= places) & (places <= high)]
        if 1 < len(places) <= MOST_TICKS:
            break
    texts = written(places)
    return viser.uplot.Axis(
        splits=tuple(places.tolist()),
        values=tuple(texts),
        size=max(50, 22 + 7 * max(map(len, texts), default=0)),
    )


def written(places: Float[np.ndarray, "k"]) -> list[str]:
    """Rising numbers with as few digits as tell what each is to a hundredth of the gaps between them."""
    gap = float(np.diff(places).min(initial=np.inf))
    texts: list[str] = []
    for digits in range(1, 16):
        texts = [f"{float(f'{place:.{digits}g}'):.15g}" for place in places]
        if all(abs(float(text) - place) <= gap / 100 for text, place in zip(texts, places, strict=True)):
            break
    return texts


class Histogram:
    """How the values of one column are spread."""

    def __init__(self, gui: viser.GuiApi):
        """An empty plot in the page's current folder."""
        self._gui = gui
        self._folder = gui.add_folder(None)
        self._handle: viser.GuiUplotHandle | None = None

    def set(self, name: str, values: Float[np.ndarray, "n"], chosen: Float[np.ndarray, "k"]) -> None:
        """Show the spread of all values and of those that the filter lets through; "" shows nothing."""
        if self._handle is not None:
            self._handle.remove()
            self._handle = None
        values, chosen = values[np.isfinite(values)], chosen[np.isfinite(chosen)]
        if not name or not len(values):
            return
        edges = np.histogram_bin_edges(values, bins=BINS)
        counts = [np.histogram(some, bins=edges)[0].astype(float) for some in (values, chosen)]
        steps = np.repeat(edges, 2)[1:-1]
        tops = [np.repeat(count, 2) for count in counts]
        series = [viser.uplot.Series(label=name)]
        for label, colour in (("all", colours.PALE_INK), ("shown", colours.CHOSEN)):
            red, green, blue = colour
            fill = f"rgba({red}, {green}, {blue}, 0.35)"
            series.append(
                viser.uplot.Series(
                    label=label, stroke=_css(colour), fill=fill, width=1, points={"show": False}
                )
            )
        with self._folder:
            self._handle = self._gui.add_uplot(
                (steps, *tops),
                tuple(series),
                title=f"trajectories by {name}",
                scales={"x": {"time": False}},
                axes=({**axis(float(edges[0]), float(edges[-1])), "size": 50}, {}),
                cursor={"drag": {"x": False, "y": False}},  # the numbers at the axis would not follow
                height=HEIGHT,
                legend={"show": False},
                padding=PADDING,
            )


def _dots(name: str) -> viser.uplot.Series:
    colour = _css(MARKS.get(name, colours.INK))
    return viser.uplot.Series(
        label=name, stroke=colour, width=0, points={"show": True, "size": 8, "fill": colour}
    )


def _line(name: str, index: int, level: bool = False) -> viser.uplot.Series:
    line = viser.uplot.Series(
        label=name,
        stroke=_css(colours.PALE_INK if level else LINES[index % len(LINES)]),
        width=1 if level else 2,
        points={"show": False},
    )
    if level:
        line["dash"] = (4, 4)
    return line


def _css(colour: Colour) -> str:
    return f"rgb({colour[0]}, {colour[1]}, {colour[2]})"
