"""The figure of a sweep: every metric against what was varied."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from doojax.experiments.training.pictures import save_figure

PANEL, LINE = 2.6, 0.24  # inches: a panel over numbers, and a line of one over names
TICKS = 0.9  # inches, of a panel's axis and title
HIGHEST = 300.0  # inches: a PNG has no more than 65536 rows of pixels

type Groups = Mapping[tuple[str, float], Sequence[float]]  # (of what, place on the axis) -> values, by seed


def draw_sweep_table(path: Path, holes: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw a panel for each metric: dots for the seeds, and their means.

    What is varied is the axis where it is one number; otherwise each combination of values has a line.

    Args:
        path: of the PNG.
        holes: names of what the spec varies.
        rows: as in sweep.csv: a metric, its tags, unit and value, and the values of the cell.
    """
    varied = [name for name in holes if name != "seed" and len({str(row[name]) for row in rows}) > 1]
    numeric = [name for name in varied if all(_is_number(row[name]) for row in rows)]
    axis = numeric[0] if len(numeric) == 1 else None
    panels: dict[tuple[str, str], dict[tuple[str, float], list[float]]] = {}
    for row in rows:
        panel = panels.setdefault((row["metric"], row["unit"] or ""), defaultdict(list))
        parts = [str(row[name]) if name in varied else "" for name in holes if name not in (axis, "seed")]
        parts.append(str(row.get("tags") or "").strip("{}").replace('"', ""))
        label = ", ".join(part for part in parts if part)
        panel[label, float(row[axis]) if axis else 0.0].append(row["value"])
    heights = [PANEL if axis else TICKS + LINE * len(groups) for groups in panels.values()]
    figure = Figure(figsize=(8, min(sum(heights), HIGHEST)), dpi=100, layout="constrained")
    every = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for place, ((metric, unit), groups) in zip(every, panels.items(), strict=True):
        name = f"{metric}, {unit}" if unit else metric
        if axis:
            _against_number(place, groups)
            place.set(xlabel=axis, ylabel=name)
        else:
            _line_by_line(place, groups)
            place.set(title=name)
        place.grid(alpha=0.3)
    save_figure(figure, path)


def _against_number(place: Axes, groups: Groups) -> None:
    labels = list(dict.fromkeys(label for label, _ in groups))
    for number, label in enumerate(labels):
        here = sorted((at, values) for (name, at), values in groups.items() if name == label)
        at = np.repeat([one for one, _ in here], [len(values) for _, values in here])
        place.scatter(at, np.concatenate([values for _, values in here]), s=12, color=f"C{number}", alpha=0.6)
        means = [float(np.mean(values)) for _, values in here]
        place.plot([one for one, _ in here], means, color=f"C{number}", label=label)
    if labels != [""]:
        place.legend(fontsize="small")


def _line_by_line(place: Axes, groups: Groups) -> None:
    for number, values in enumerate(groups.values()):
        place.scatter(values, np.full(len(values), number), s=12, color="C0", alpha=0.6)
        place.scatter([float(np.mean(values))], [number], marker="|", s=160, color="C1")
    place.set_yticks(range(len(groups)), [label or "all" for label, _ in groups], fontsize="small")
    place.set_ylim(len(groups) - 0.5, -0.5)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
