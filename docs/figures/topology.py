"""Draws docs/figures/topology.png: python docs/figures/topology.py"""

import re
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from doojax.topology import field_line, linking_of, loops_of, signature
from doojax.topology.describe import THREADING, read_scene

OBSTACLE, FIELD, ROPE = "#4d4d4d", "#74a9cf", "#c9b79c"
COLOURS = ["#d95f02", "#1b6ca8"]
PIECES = 240


def finely(points):
    """A polyline in short pieces, which can be sorted by depth."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0], np.cumsum(steps)])
    at = np.unique(np.concatenate([np.linspace(0, along[-1], PIECES), along]))
    return np.stack([np.interp(at, along, points[:, axis]) for axis in range(3)], axis=1)


def camera(azimuth, elevation):
    """Screen right, screen up and towards the viewer, as columns; angles in degrees."""
    a, e = np.deg2rad([azimuth, elevation])
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0])
    return np.stack([right, np.cross(towards, right), towards], axis=1)


def draw(axes, view, curves):
    """Draw curves (points, colour, width): nearer pieces over farther ones, with gaps where they cross."""
    starts, ends, styles, owner, order = [], [], [], [], []
    for number, (points, colour, width) in enumerate(curves):
        seen = finely(np.asarray(points, float)) @ view
        starts.append(seen[:-1])
        ends.append(seen[1:])
        styles += [(colour, width)] * (len(seen) - 1)
        owner += [number] * (len(seen) - 1)
        order += range(len(seen) - 1)
    starts, ends, owner, order = (
        np.concatenate(starts),
        np.concatenate(ends),
        np.array(owner),
        np.array(order),
    )
    middles = (starts + ends) / 2
    gap = 0.025 * np.ptp(middles, axis=0)[:2].max()
    for piece in np.argsort(middles[:, 2]):
        colour, width = styles[piece]
        near = np.linalg.norm(middles[:, :2] - middles[piece, :2], axis=1) < gap
        behind = middles[:, 2] < middles[piece, 2] - gap
        beyond_a_corner = (owner != owner[piece]) | (np.abs(order - order[piece]) > PIECES // 10)
        if np.any(near & behind & beyond_a_corner):
            axes.plot(
                *np.stack([starts[piece], ends[piece]])[:, :2].T,
                color="white",
                linewidth=width + 5,
                solid_capstyle="butt",
            )
        axes.plot(
            *np.stack([starts[piece], ends[piece]])[:, :2].T,
            color=colour,
            linewidth=width,
            solid_capstyle="round",
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.09)
    axes.axis("off")


def mark(axes, view, point, text, offset=(0, 0), colour="black", dot=False):
    """Write a text beside a point, an offset in typographical points away."""
    at = (np.asarray(point) @ view)[:2]
    if dot:
        axes.plot(*at, "o", color="black", markersize=7, markeredgecolor="white", zorder=5)
    style = {"ha": "center", "va": "center", "fontsize": 11, "color": colour, "zorder": 6}
    axes.annotate(text, at, offset, textcoords="offset points", **style)


def circle(radius, centre, u, v, count=80):
    """A closed polyline."""
    t = np.linspace(0, 2 * np.pi, count + 1)[:, None]
    return np.asarray(centre) + radius * (np.cos(t) * np.asarray(u) + np.sin(t) * np.asarray(v))


def draw_links(panels):
    """Pairs of loops, and a field."""
    ring = circle(1, (0, 0, 0), (1, 0, 0), (0, 1, 0))
    t = np.linspace(0, 2 * np.pi, 121)
    eight = np.stack([2 * np.cos(t), np.sin(2 * t), 0.3 * (np.sin(t) + 1.5 * np.sin(3 * t))], axis=1)
    through = circle(1.1, (1.1, 0, 0), (1, 0, 0), (0, 0, 1))
    beside = circle(0.7, (2.1, 0, 0.3), (1, 0, 0), (0, 0, 1))
    side, above = camera(-70, 25), camera(-90, 89)
    links = [("through", through, side), ("beside", beside, side), ("Whitehead link", eight, above)]
    for axes, (name, curve, view) in zip(panels, links, strict=False):
        number = int(linking_of(np.float32(curve), np.float32(ring)).number)
        draw(axes, view, [(ring, OBSTACLE, 3), (curve, COLOURS[0], 3)])
        axes.set_title(f"{name}: {abs(number)}", fontsize=11)

    starts = [(radius, 0, 0) for radius in (-0.75, -0.45, 0.45, 0.75)]
    lines = [
        [field_line(np.float32(ring), np.float32(start), step=step, count=50) for step in (0.03, -0.03)]
        for start in starts
    ]
    lines = [np.concatenate([np.asarray(back)[::-1], np.asarray(forth)]) for forth, back in lines]
    axes = panels[3]
    draw(axes, side, [(ring, OBSTACLE, 3), *((line, FIELD, 2) for line in lines)])
    for line in lines:
        tail, head = (line[[70, 72]] @ side)[:, :2]
        axes.annotate("", head, tail, arrowprops={"arrowstyle": "-|>", "color": FIELD, "mutation_scale": 16})
    first, second = (ring[[57, 59]] @ side)[:, :2]
    axes.annotate(
        "", second, first, arrowprops={"arrowstyle": "-|>", "color": OBSTACLE, "mutation_scale": 20}
    )
    axes.set_title("the field shows the way through", fontsize=11)


def draw_scene(axes, view, scene, spread):
    """Obstacle loops, the rope (thick) and the tethers (thin) of a scene, a colour for each grasp loop."""
    loops = loops_of(scene.grasps)
    curves = [(loop, OBSTACLE, 3) for loop in scene.skeleton.loops]
    curves.append((scene.grasps.rope - 0.03 * view[:, 2], ROPE, 5))
    on_rope = len(scene.grasps.rope)
    tether = (loops.points.shape[1] - on_rope) // 2
    for place in np.flatnonzero(loops.active):
        points, colour = np.asarray(loops.points[place]), COLOURS[place]
        aside = view[:, 0] * spread * (1 if place else -1)  # so that a tether of two loops shows both
        curves.append((points[:tether] + aside, colour, 2))
        curves.append((points[tether + on_rope :] + aside, colour, 2))
        curves.append((points[tether - 1 : tether + on_rope + 1], colour, 5))
    draw(axes, view, curves)
    return np.asarray(loops.points)


def main():
    """Draw both rows."""
    figure = plt.figure(figsize=(11, 8))
    top, bottom = figure.subfigures(2, 1, height_ratios=[0.5, 1])
    draw_links(
        top.subplots(
            1, 4, gridspec_kw={"left": 0.01, "right": 0.99, "bottom": 0, "top": 0.76, "wspace": 0.05}
        )
    )
    top.suptitle("Linking numbers of two loops, without sign", fontsize=13, fontweight="bold")

    left, right = bottom.subplots(
        1, 2, gridspec_kw={"left": 0.01, "right": 0.99, "bottom": 0, "top": 0.88, "wspace": 0.02}
    )
    bottom.suptitle("Grasp loop signatures", fontsize=13, fontweight="bold")
    scene, view = page_scene(), camera(-74, 32)
    draw_scene(left, view, scene, 0.02)
    left.set_title(f"two frames: {signature(scene.grasps, scene.skeleton)}", fontsize=12)
    explain(left, 0.7, ["(1,0): through A, not through B", "(0,1): through B, not through A"])
    for point, text, offset, dot in [
        ((1, -1, 0), "base", (26, 0), True),
        ((0.8, 1, 0), "right", (8, 16), True),
        ((1.8, 1, 0), "left", (6, 16), True),
        ((0, 1, 0), "wall", (-4, 18), True),
        ((0.5, 1.2, 0.2), "A", (0, 12), False),
        ((1.5, 1.2, 0.2), "B", (0, 12), False),
    ]:
        mark(left, view, point, text, offset, dot=dot)
    mark(left, view, (1, -1, -0.6), "path to the wall, through the floor", (110, -6), colour=COLOURS[0])
    mark(left, view, (0.9, 0, 0), "right arm", (-36, 8))
    mark(left, view, (1.4, 0, 0), "left arm", (36, -8))

    scene, view = read_scene(THREADING), camera(-62, 28)
    draw_scene(right, view, scene, 0.014)
    right.set_title(f"threading: {signature(scene.grasps, scene.skeleton)}", fontsize=12)
    explain(right, 0.545, ["(1,0,0): through loop1", "(0,1,1): loop2 and loop3"])
    held = [scene.grasps.rope[0], *scene.grasps.gripper_paths[:, -1], scene.grasps.base]
    offsets = [(26, 0), (-4, 20), (-22, -14), (28, -4)]
    for point, text, offset in zip(held, ["plug", "left", "right", "base"], offsets, strict=True):
        mark(right, view, point, text, offset, dot=True)
    for name, loop in zip(scene.skeleton.names, scene.skeleton.loops, strict=True):
        mark(right, view, loop[3], name, (10, 12))
    for arm, text, offset in [(0, "left arm", (-44, 0)), (1, "right arm", (36, 4))]:
        mark(right, view, scene.grasps.gripper_paths[arm, 6], text, offset)
    mark(right, view, (0.4, 0.3, -0.8), "path to the plug, through the floor", (34, -22), colour=COLOURS[0])
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


def explain(axes, across, lines):
    """Say inside of a scene what the vector of each grasp loop means, in the loop's colour."""
    for line, (text, colour) in enumerate(zip(lines, COLOURS, strict=True)):
        at = (across, 0.3 - 0.05 * line)
        axes.text(*at, text, transform=axes.transAxes, ha="center", color=colour, fontsize=11)


def page_scene():
    """The scene that docs/topology.md describes."""
    page = (Path(__file__).parents[1] / "topology.md").read_text(encoding="utf-8")
    with TemporaryDirectory() as folder:
        file = Path(folder) / "scene.json"
        file.write_text(re.search(r"```json\n(.*?)```", page, re.DOTALL)[1], encoding="utf-8")
        return read_scene(file)


if __name__ == "__main__":
    main()
