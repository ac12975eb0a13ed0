"""Pictures and animations, made without a browser."""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from doojax.datasets import Dataset
from doojax.viewer import colours
from doojax.viewer.episodes import Episode, episode, require_rope, title
from doojax.viewer.films import FROM_SIDE as FROM_SIDE
from doojax.viewer.films import Film
from doojax.viewer.paint import Painting, Pixels, font
from doojax.viewer.raycast import Camera
from doojax.viewer.show import gripper_radius, show_ways

UP = np.array([0.0, 0.0, 1.0])
MARGIN = 1.08  # of a picture's span to that of its contents
GHOSTS = 5  # earlier states shown in a still picture
SQUARE_PANEL, WIDE_PANEL = (300, 300), (380, 280)  # pixels
SQUARE_FRAME, WIDE_FRAME = (480, 480), (640, 460)
FLOOR_REACH = 0.2  # m: a floor further below everything shown is left out
FRAMES_PER_SECOND = 20
BETWEEN_STATES = 2  # frames
HEADER = 44  # pixels
TOUCHING = 0.002  # m to an obstacle: in contact


def contact_sheet(dataset: Dataset, indices: Sequence[int], path: Path | str) -> None:
    """A PNG with one panel for each of some trajectories: where the rope was, from pale to dark.

    Args:
        dataset: any data set with ropes.
        indices: of the trajectories.
        path: the file to write, ending in .png.

    Raises:
        ValueError: for no indices, a data set without ropes, a damaged chunk file (named), or another ending.
        IndexError: for an index outside of the data set.
    """
    require_rope(dataset)
    if Path(path).suffix != ".png":
        raise ValueError(f"a contact sheet is a .png file, got {path}")
    if not len(indices):
        raise ValueError("no trajectories were chosen: give at least one index")
    shown = [episode(dataset, index) for index in indices]
    wide, high = SQUARE_PANEL if all(one.planar for one in shown) else WIDE_PANEL
    columns = int(np.ceil(np.sqrt(len(indices) * 1.25 * high / wide)))
    rows = -(-len(indices) // columns)
    gap, caption, footer = 12, 24, 40
    width = gap + columns * (wide + gap)
    height = HEADER + rows * (high + caption + gap) + footer
    sheet = Image.new("RGB", (width, height), (255, 255, 255))
    pen = ImageDraw.Draw(sheet)
    pen.text((gap, HEADER / 2), fitted(title(dataset), width - 2 * gap, 20), colours.INK, font(20), "lm")
    for place, (index, one) in enumerate(zip(indices, shown, strict=True)):
        row, column = divmod(place, columns)
        left, top = gap + column * (wide + gap), HEADER + row * (high + caption + gap)
        sheet.paste(Image.fromarray(still(one, wide, high)), (left, top))
        pen.rectangle((left, top, left + wide - 1, top + high - 1), outline=(214, 218, 224))
        words = fitted(caption_of(dataset, index), wide, 14)
        pen.text((left + 2, top + high + 11), words, colours.INK, font(14), "lm")
    _time_bar(pen, gap, height - footer / 2, (len(shown[0].points) - 1) * shown[0].period, width - 2 * gap)
    sheet.save(path, optimize=True)


def still(shown: Episode, width: int, height: int) -> Pixels:
    """One picture of all of a trajectory: earlier ropes pale, the last dark, and the grippers' ways."""
    painting = painting_of(shown.corners(), shown.look.floor, shown.planar, width, height)
    painting.obstacles("obstacles", shown.obstacles, colour=colours.OBSTACLE)
    painting.settle()
    known = np.flatnonzero(shown.finite)
    if known.size:
        chosen = known[np.unique(np.linspace(0, known.size - 1, GHOSTS + 1).astype(int))]
        ramp = colours.scale("time", np.linspace(0, 1, len(chosen)))
        for moment, colour in zip(chosen, ramp, strict=True):
            last = moment == chosen[-1]
            radius = shown.look.rope_radius * (1.0 if last else 0.7)
            tint = (int(colour[0]), int(colour[1]), int(colour[2]))
            if shown.look.what == "body":
                painting.spheres(f"bodies/{moment}", shown.points[moment], radius=radius, colours=tint)
            else:
                painting.rope(f"rope/{moment}", shown.ropes[moment], radius=radius, colour=tint)
        draw_tracks(painting, shown, int(known[-1]))
        painting.spheres(
            "grippers", shown.grippers[known[-1]], radius=gripper_radius(shown.look), colours=colours.GRIPPER
        )
    return painting.image()


def animate(film: Film, path: Path | str) -> None:
    """A GIF or MP4 of a film, several times faster than it happened; frame by frame, as large as a page.

    Raises:
        ValueError: for an ending that is neither .gif nor .mp4.
    """
    path = Path(path)
    if path.suffix == ".gif":
        pictures = [Image.fromarray(frame).quantize(96, dither=Image.Dither.NONE) for frame in frames(film)]
        duration = [1000 // FRAMES_PER_SECOND] * (len(pictures) - 1) + [1200]
        pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=duration, loop=0)
    elif path.suffix == ".mp4":
        stack = np.stack(list(frames(film)))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "os.fork")  # the child runs ffmpeg at once, and no JAX
            imageio.imwrite(
                path, stack, plugin="FFMPEG", fps=FRAMES_PER_SECOND, codec="libx264", macro_block_size=2
            )
    else:
        raise ValueError(f"an animation is a .gif or .mp4 file, got {path}")


def frames(film: Film, moments: Sequence[float] | None = None) -> Iterator[Pixels]:
    """Pictures of a film at some moments (in states); by default, all that an animation needs."""
    last = film.states - 1
    wide, high = SQUARE_FRAME if film.planar else WIDE_FRAME
    painting = painting_of(film.corners, film.floor, film.planar, wide, high, film.seen_from)
    film.set_up(painting)
    painting.settle()
    for moment in np.linspace(0, last, last * BETWEEN_STATES + 1) if moments is None else moments:
        film.show(painting, float(moment))
        yield framed(painting.image(), film.title, float(moment) * film.period, last * film.period)


def painting_of(
    corners: Float[np.ndarray, "K 3"],
    floor: float | None,
    planar: bool,
    width: int,
    height: int,
    direction: Float[np.ndarray, "3"] = FROM_SIDE,
) -> Painting:
    """An empty picture around some points, from above if everything moves in a plane."""
    low, high = corners.min(0), corners.max(0)
    if floor is not None and low[2] > floor + FLOOR_REACH:
        floor = None
    camera = (
        camera_above(corners, width, height) if planar else camera_from(direction, corners, width, height)
    )
    return Painting(camera, low, high, floor)


def camera_above(corners: Float[np.ndarray, "K 3"], width: int, height: int) -> Camera:
    """A parallel view from above that has all of some points in its picture, as large as it can."""
    low, high = corners.min(0), corners.max(0)
    middle, extent = (low + high) / 2, high - low
    span = MARGIN * float(max(extent[1], extent[0] * height / width))
    return Camera.looking(middle + 5 * UP, middle, np.array([0.0, 1.0, 0.0]), width, height, span)


def camera_from(
    direction: Float[np.ndarray, "3"],
    corners: Float[np.ndarray, "K 3"],
    width: int,
    height: int,
    margin: float = MARGIN,
    visible: float = 1.0,
) -> Camera:
    """A camera in some direction that has all of some points in its picture, as large as it can.

    Args:
        direction: from the points to the camera, a unit vector.
        corners: the points, m.
        width: of the picture, pixels.
        height: of the picture, pixels.
        margin: of the picture's span to that of the points.
        visible: the part of the picture's height, from its top, that nothing hides.
    """
    low, high = corners.min(0), corners.max(0)
    middle = (low + high) / 2
    distance = 2 * float(np.linalg.norm(high - low))

    def at() -> Camera:
        return Camera.looking(middle + distance * direction, middle, UP, width, height, None)

    for _ in range(12):  # centre and fit in turns: perspective ties the two together
        camera = at()
        column, row, depth = camera.project(corners)
        right = (column.min() + column.max()) / 2 - width / 2
        down = (row.min() + row.max()) / 2 - visible * height / 2
        metres = float(np.median(depth)) / camera.scale
        middle = middle + metres * (right * camera.axes[0] - down * camera.axes[1])
        distance *= margin * max(float(np.ptp(column)) / width, float(np.ptp(row)) / (visible * height))
    return at()


def draw_tracks(painting: Painting, shown: Episode, until: int) -> None:
    """The ways of the grippers up to a moment."""
    show_ways(painting, "tracks", shown.grippers[: until + 1], colours.GRIPPER, width=1.0)


def framed(pixels: Pixels, caption: str, time: float, end: float) -> UInt8[np.ndarray, "h2 w 3"]:
    """A frame with its title, the time, and a bar that says how much of it has passed."""
    height, width = pixels.shape[:2]
    frame = Image.new("RGB", (width, height + HEADER), (255, 255, 255))
    frame.paste(Image.fromarray(pixels), (0, HEADER))
    pen = ImageDraw.Draw(frame)
    clock = f"{time:.1f} s"
    pen.text((10, HEADER / 2 - 3), fitted(caption, width - 90, 16), colours.INK, font(16), "lm")
    pen.text((width - 10, HEADER / 2 - 3), clock, colours.PALE_INK, font(16), "rm")
    pen.rectangle((0, HEADER - 4, width, HEADER - 1), (226, 229, 234))
    pen.rectangle((0, HEADER - 4, width * time / max(end, 1e-9), HEADER - 1), colours.ROPE)
    return np.asarray(frame)


def caption_of(dataset: Dataset, index: int) -> str:
    """A trajectory's number, its greatest stretch and its least clearance."""
    parts = [f"#{dataset.rows[index]}"]
    if "stretch" in dataset.fields:
        parts.append(f"stretch {max(0.0, float(np.nanmax(dataset['stretch'][index]))):.1%}")
    if "clearance" in dataset.fields:
        least = float(np.nanmin(dataset["clearance"][index]))
        near = "touching" if least < TOUCHING else f"clearance {1000 * least:.0f} mm"
        parts.append(near if least < 10 else "no obstacles")
    if "faults" in dataset.fields and dataset["faults"][index].any():
        parts.append("FAULT")
    return "  ".join(parts)


def fitted(text: str, width: int, size: int) -> str:
    """``text``, cut where it would not fit into ``width`` pixels."""
    while len(text) > 4 and font(size).getlength(text) > width:
        text = text[:-4] + "..."
    return text


def _time_bar(pen: ImageDraw.ImageDraw, left: int, middle: float, seconds: float, width: int) -> None:
    pen.text((left, middle), "start", colours.PALE_INK, font(14), "lm")
    bar = min(160, width // 3)
    for place in range(bar):
        red, green, blue = colours.scale("time", np.array(place / bar))
        at = left + 42 + place
        pen.line((at, middle - 6, at, middle + 6), fill=(int(red), int(green), int(blue)))
    text = f"end, after {seconds:.0f} s;  dark: grippers and the ways they took"
    pen.text((left + 50 + bar, middle), fitted(text, width - 50 - bar, 14), colours.PALE_INK, font(14), "lm")
