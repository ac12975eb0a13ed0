"""Pictures of a data set without a browser: `doojax render`."""

from pathlib import Path

import imageio.v3 as iio
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from rich.console import Console

from doojax.datasets import Dataset
from doojax.types import ShapeKind

OBSTACLE, FLOOR, GRIPPER = "#8f99a6", "#f6f4ef", "#d1495b"
SHEET = (4, 6)  # rows and columns
FRAMES_PER_SECOND = 10


def render(path: Path, /, *, out: Path, trajectory: int | None = None) -> None:
    """Draw a data set from above: a sheet of many trajectories (.png), or a moving picture (.gif, .mp4).

    Args:
        path: the data set.
        out: the file to write; its ending says what it is to be.
        trajectory: which one; by default the moving picture shows a whole sheet.

    Raises:
        ValueError: for another ending, or a trajectory that does not exist.
    """
    dataset = Dataset.open(path)
    if out.suffix not in (".png", ".gif", ".mp4"):
        raise ValueError(f"{out} ends in {out.suffix!r}, expected .png, .gif or .mp4")
    if trajectory is not None and not 0 <= trajectory < len(dataset):
        raise ValueError(f"there is no trajectory {trajectory}: {path} holds 0 to {len(dataset) - 1}")
    shown = [trajectory] if trajectory is not None else _most_moving(dataset)
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".png":
        iio.imwrite(out, _draw(dataset, shown, time=None))
    else:
        frames = [_draw(dataset, shown, time) for time in range(dataset.fields["points"].shape[0])]
        if out.suffix == ".gif":
            iio.imwrite(out, np.stack(frames), loop=0, duration=1000 / FRAMES_PER_SECOND)
        else:
            iio.imwrite(out, np.stack(frames), fps=FRAMES_PER_SECOND, macro_block_size=2)
    Console(stderr=True).print(f"drew {len(shown)} of {len(dataset)} trajectories in {out}", highlight=False)


def _most_moving(dataset: Dataset) -> list[int]:
    """As many trajectories as a sheet holds: those whose tail travels farthest, in stored order."""
    tails = dataset["points"][: min(len(dataset), 512)][:, :, 0]
    travelled = np.nan_to_num(np.linalg.norm(np.diff(tails, axis=1), axis=-1).sum(1))
    count = min(SHEET[0] * SHEET[1], len(travelled))
    return sorted(np.argsort(-travelled, kind="stable")[:count].tolist())


def _draw(dataset: Dataset, shown: list[int], time: int | None) -> np.ndarray:
    columns = min(SHEET[1], len(shown))
    rows = -(-len(shown) // columns)
    size = 5.0 if len(shown) == 1 else 1.9
    figure = Figure(figsize=(columns * size, rows * size + 0.45), dpi=100, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    config, last = dataset.config, dataset.fields["points"].shape[0] - 1
    when = f"{last + 1} states each, pale to dark" if time is None else f"state {time} of {last}"
    title = ", ".join(str(config.get(name)) for name in ("task", "phase", "engine"))
    title = f"{title}, seed {config.get('seed')}: {when}"
    figure.suptitle(title, fontsize=10, y=1 - 0.12 / figure.get_figheight())
    low, high = _extent(dataset, shown)
    for panel, index in enumerate(shown):
        axes = figure.add_subplot(rows, columns, panel + 1)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", facecolor=FLOOR)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.text(0.03, 0.97, str(index), transform=axes.transAxes, fontsize=7, va="top", color="#555555")
        _draw_obstacles(axes, dataset, index)
        _draw_rope(axes, dataset, index, time)
    figure.subplots_adjust(0.01, 0.01, 0.99, 1 - 0.35 / figure.get_figheight(), wspace=0.04, hspace=0.04)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _extent(dataset: Dataset, shown: list[int]) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([dataset[name][shown].reshape(-1, 3) for name in ("points", "grippers")])
    low, high = np.nanmin(points, 0)[:2] - 0.08, np.nanmax(points, 0)[:2] + 0.08
    half = (high - low).max() / 2  # square panels
    return (low + high) / 2 - half, (low + high) / 2 + half


def _draw_obstacles(axes, dataset: Dataset, index: int) -> None:
    fields = ("kind", "centre", "quaternion", "half_size", "active")
    stored = [dataset[f"obstacle_{name}"][index] for name in fields]
    highest_last = np.argsort(stored[1][:, 2] + stored[3][:, 2])
    for shape in highest_last:
        kind, centre, (w, x, y, z), half, active = (values[shape] for values in stored)
        if not active:
            continue
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        style = {"facecolor": OBSTACLE, "edgecolor": "#5d6671", "linewidth": 0.6, "alpha": 0.85}
        if kind == ShapeKind.BOX:
            corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half[:2]
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            axes.add_patch(Polygon(corners @ turn.T + centre[:2], **style))
        else:
            axes.add_patch(Circle((centre[0], centre[1]), half[0], **style))


def _draw_rope(axes, dataset: Dataset, index: int, time: int | None) -> None:
    points, grippers = dataset["points"][index], dataset["grippers"][index]
    steps = len(points)
    times = np.unique(np.linspace(0, steps - 1, 8).astype(int)) if time is None else [time]
    colours = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 0.95, steps))
    lines = [points[t, :, :2] for t in times]
    axes.add_collection(LineCollection(lines, colors=colours[times], linewidths=2.2, capstyle="round"))
    trail = grippers[: times[-1] + 1]
    for hand in range(trail.shape[1]):
        axes.plot(*trail[:, hand, :2].T, color=GRIPPER, linewidth=0.7, alpha=0.6)
        axes.plot(*trail[-1, hand, :2], marker="o", markersize=4, color=GRIPPER)
