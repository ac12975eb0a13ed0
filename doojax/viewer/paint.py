"""A `Drawing` that becomes a picture: shaded, with shadows, without a window."""

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter

from doojax.experiments.drawing import Colour
from doojax.types import Obstacles, ShapeKind
from doojax.viewer import colours
from doojax.viewer.episodes import rotation_matrices
from doojax.viewer.raycast import NOTHING, Buffers, Camera, Solid, Vector, pixel_and_depth, shadow_camera
from doojax.viewer.shapes import smooth

OVERSAMPLING = 2  # rays per pixel and direction
SUBPIXELS = [(row, column) for row in range(OVERSAMPLING) for column in range(OVERSAMPLING)]
LIGHT = np.array([-0.30, -0.24, 0.92], dtype=np.float32) / np.float32(np.linalg.norm([-0.30, -0.24, 0.92]))
AMBIENT = 0.76  # of the light that reaches a surface in shadow
OUTLINE = 0.72  # brightness of the edge of a body
SHADOW_BLUR = 1.6  # pixels

Pixels = UInt8[np.ndarray, "h w 3"]


class Painting:
    """Implements `doojax.experiments.drawing.Drawing`; `image` paints what has been drawn.

    What is drawn before `settle` is the background, painted once however many images follow.
    """

    def __init__(self, camera: Camera, low: Vector, high: Vector, floor: float | None = 0.0):
        """Paint what lies between the corners ``low`` and ``high`` as ``camera`` sees it.

        Args:
            camera: its width and height are the picture's.
            low: least x, y, z of everything that casts a shadow, metres.
            high: greatest x, y, z.
            floor: height of the floor, metres; None for a picture without one.
        """
        wide, high_pixels = camera.width * OVERSAMPLING, camera.height * OVERSAMPLING
        self._camera = Camera(camera.eye, camera.axes, wide, high_pixels, camera.span, camera.tangent)
        self._sun = shadow_camera(LIGHT, np.asarray(low, np.float32), np.asarray(high, np.float32))
        self._bias = 3 * (self._sun.span or 0.0) / self._sun.height
        self._bodies: dict[str, list[list[Solid]]] = {}  # a body's solids have one outline
        self._marks: dict[str, tuple[np.ndarray, np.ndarray, int]] = {}  # places, colours, pixels
        self._texts: dict[str, tuple[str, np.ndarray]] = {}
        self._background = Buffers(self._camera)
        self._background_light = Buffers(self._sun)
        if floor is not None:
            thickness = np.array([50, 50, 0.5], dtype=np.float32)
            place = np.array([0, 0, floor - 0.5], dtype=np.float32)
            ground = Solid(ShapeKind.BOX, place, np.eye(3, dtype=np.float32), thickness, colours.FLOOR)
            self._background.add(ground, 0)
        self._owners = 1
        self._remember_background()

    def rope(
        self,
        name: str,
        points: Float[np.ndarray, "N 3"],
        *,
        radius: float,
        colour: Colour,
        opacity: float = 1.0,
    ) -> None:
        """See `Drawing.rope`."""
        self.remove(name)
        points = np.asarray(points, dtype=np.float32)
        if not np.isfinite(points).all():
            return
        curve = smooth(points)
        if opacity < 1:  # overlapping capsules would darken their joints
            self.lines(
                name,
                np.stack([curve[:-1], curve[1:]], axis=1),
                width=2 * radius * self._camera.scale / OVERSAMPLING,
                colours=colour,
            )
            return
        middles, halves = (curve[:-1] + curve[1:]) / 2, (curve[1:] - curve[:-1]) / 2
        lengths = np.linalg.norm(halves, axis=1)
        sizes = np.stack([np.full(len(lengths), radius), np.full(len(lengths), radius), lengths], axis=1)
        self._bodies[name] = [
            [
                Solid(ShapeKind.CAPSULE, middle, _frame_along(half), size.astype(np.float32), colour)
                for middle, half, size in zip(middles, halves, sizes, strict=True)
            ]
        ]

    def spheres(
        self,
        name: str,
        centres: Float[np.ndarray, "K 3"],
        *,
        radius: float,
        colours: Colour | UInt8[np.ndarray, "K 3"],
        opacity: float = 1.0,
    ) -> None:
        """See `Drawing.spheres`."""
        self.remove(name)
        size, turn = np.array([radius, radius, 0], dtype=np.float32), np.eye(3, dtype=np.float32)
        each = np.broadcast_to(np.asarray(colours), (len(centres), 3))
        self._bodies[name] = [
            [Solid(ShapeKind.CAPSULE, np.asarray(centre, np.float32), turn, size, tuple(colour), opacity)]
            for centre, colour in zip(centres, each.tolist(), strict=True)
            if np.isfinite(centre).all()
        ]

    def points(
        self,
        name: str,
        points: Float[np.ndarray, "K 3"],
        *,
        size: float,
        colours: Colour | UInt8[np.ndarray, "K 3"],
    ) -> None:
        """See `Drawing.points`."""
        self.remove(name)
        points = np.asarray(points, dtype=np.float32)
        each = np.broadcast_to(np.asarray(colours, dtype=np.float32), points.shape)
        _, _, depth = self._camera.project(points)
        near = np.median(depth) if len(points) and self._camera.span is None else 1.0
        self._marks[name] = (points, each, max(2, round(size * self._camera.scale / near)))

    def lines(
        self,
        name: str,
        segments: Float[np.ndarray, "K 2 3"],
        *,
        width: float,
        colours: Colour | UInt8[np.ndarray, "K 3"],
    ) -> None:
        """See `Drawing.lines`."""
        self.remove(name)
        segments = np.asarray(segments, dtype=np.float32)
        each = np.broadcast_to(np.asarray(colours, dtype=np.float32), (len(segments), 3))
        column, row, _ = self._camera.project(segments)
        reach = np.hypot(column[:, 1] - column[:, 0], row[:, 1] - row[:, 0])
        reach = np.nan_to_num(reach, nan=0.0, posinf=0.0).clip(0, 4 * self._camera.width)
        count = np.ceil(reach).astype(int) + 1
        which = np.repeat(np.arange(len(segments)), count)
        first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(int)
        along = (np.arange(len(which)) - first[which]) / np.maximum(count[which] - 1, 1)
        start, end = segments[which, 0], segments[which, 1]
        places = start + along[:, None].astype(np.float32) * (end - start)
        self._marks[name] = (places, each[which], max(1, round(width * OVERSAMPLING)))

    def cones(
        self,
        name: str,
        segments: Float[np.ndarray, "K 2 3"],
        *,
        radius: float,
        colours: Colour | UInt8[np.ndarray, "K 3"],
    ) -> None:
        """See `Drawing.cones`; too slender for their shape to be seen."""
        self.lines(name, segments, width=1.0, colours=colours)

    def obstacles(self, name: str, obstacles: Obstacles, *, colour: Colour, opacity: float = 1.0) -> None:
        """See `Drawing.obstacles`; a table top is drawn in its own colour."""
        each = [
            colours.obstacle_colour(half_size) if colour == colours.OBSTACLE else colour
            for half_size in np.asarray(obstacles.half_size)
        ]
        self.bodies(name, obstacles, colours=np.array(each, np.uint8).reshape(-1, 3), opacity=opacity)

    def bodies(
        self,
        name: str,
        shapes: Obstacles,
        *,
        colours: Colour | UInt8[np.ndarray, "K 3"],
        opacity: float = 1.0,
    ) -> None:
        """See `Drawing.bodies`."""
        self.remove(name)
        kind, centre, half_size, active = (
            np.asarray(getattr(shapes, field)) for field in ("kind", "centre", "half_size", "active")
        )
        turn = rotation_matrices(np.asarray(shapes.quaternion))
        each = np.broadcast_to(np.asarray(colours, np.uint8), (len(kind), 3)).tolist()
        self._bodies[name] = [
            [
                Solid(
                    int(kind[i]),
                    centre[i].astype(np.float32),
                    turn[i],
                    half_size[i].astype(np.float32),
                    tuple(each[i]),
                    opacity,
                )
            ]
            for i in np.flatnonzero(active)
        ]

    def axes(
        self,
        name: str,
        position: Float[np.ndarray, "3"],
        quaternion: Float[np.ndarray, "4"],
        *,
        length: float = 0.1,
    ) -> None:
        """See `Drawing.axes`."""
        tips = position + length * rotation_matrices(np.asarray(quaternion)[None])[0].T
        segments = np.stack([np.broadcast_to(position, (3, 3)), tips], axis=1)
        self.lines(name, segments, width=2.0, colours=np.array(colours.AXES, np.uint8))

    def text(self, name: str, text: str, position: Float[np.ndarray, "3"]) -> None:
        """See `Drawing.text`."""
        self.remove(name)
        self._texts[name] = (text, np.asarray(position, np.float32))

    def remove(self, name: str) -> None:
        """See `Drawing.remove`; the background stays."""
        for shown in (self._bodies, self._marks, self._texts):
            for key in [key for key in shown if key == name or key.startswith(f"{name}/")]:
                del shown[key]

    def settle(self) -> None:
        """Make the solids drawn so far the background of all further images."""
        self._put(self._background)
        self._put(self._background_light)
        self._owners += sum(len(group) for group in self._bodies.values())
        self._bodies.clear()
        self._remember_background()

    def image(self) -> Pixels:
        """What the camera sees."""
        seen = self._background.copy()
        light = Buffers(self._sun)
        self._put(seen)
        self._put(light)
        shade = self._background_shade.copy()
        if self._bodies:
            place, distance = self._background_in_light
            shade[self._solid_background] |= light.depth.ravel()[place] < distance
            fresh = seen.owner != self._background.owner
            place, distance = pixel_and_depth(self._sun, seen.positions(fresh))
            both = np.minimum(light.depth, self._background_light.depth).ravel()
            shade[fresh] = both[place] < distance - self._bias
        bright = ((seen.normal @ LIGHT) / LIGHT[2]).clip(0, 1.12)
        bright *= 1 - gaussian_filter(shade.astype(np.float32), SHADOW_BLUR, mode="nearest", truncate=2)
        bright = AMBIENT + (1 - AMBIENT) * bright
        bright[seen.owner < 0] = 1
        edge = np.zeros(seen.owner.shape, dtype=bool)
        edge[:, 1:] |= seen.owner[:, 1:] != seen.owner[:, :-1]
        edge[1:] |= seen.owner[1:] != seen.owner[:-1]
        bright[edge] *= OUTLINE
        pixels = seen.colour * bright[..., None]
        for places, each, thickness in self._marks.values():
            _stamp(pixels, seen.depth, self._camera, places, each, thickness)
        corners = [pixels[row::OVERSAMPLING, column::OVERSAMPLING] for row, column in SUBPIXELS]
        return self._with_texts(np.clip(sum(corners) / len(SUBPIXELS), 0, 255).astype(np.uint8))

    def _put(self, buffers: Buffers) -> None:
        bodies = [body for group in self._bodies.values() for body in group]
        for owner, body in enumerate(bodies, start=self._owners):
            for solid in body:
                if solid.opacity == 1:
                    buffers.add(solid, owner)
        if buffers.camera is self._camera:  # what is translucent throws no shadow
            for body in bodies:
                for solid in body:
                    if solid.opacity < 1:
                        buffers.add(solid, -1)

    def _remember_background(self) -> None:
        self._background.colour[self._background.owner < 0] = colours.FLOOR
        self._solid_background = self._background.depth < NOTHING
        place, distance = pixel_and_depth(self._sun, self._background.positions(self._solid_background))
        self._background_in_light = place, distance - self._bias
        self._background_shade = np.zeros(self._background.depth.shape, dtype=bool)
        self._background_shade[self._solid_background] = (
            self._background_light.depth.ravel()[place] < distance - self._bias
        )

    def _with_texts(self, pixels: Pixels) -> Pixels:
        if not self._texts:
            return pixels
        picture = Image.fromarray(pixels)
        pen = ImageDraw.Draw(picture)
        for text, place in self._texts.values():
            column, row, _ = self._camera.project(place)
            at = (float(column) / OVERSAMPLING + 6, float(row) / OVERSAMPLING - 6)
            pen.text(at, text, fill=colours.INK, font=font(14), stroke_width=2, stroke_fill=(255, 255, 255))
        return np.asarray(picture)


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The letters of every picture; ``size`` in pixels."""
    return ImageFont.load_default(size)


def _frame_along(axis: Vector) -> Float[np.ndarray, "3 3"]:
    """A rotation whose third column points along ``axis``."""
    length = float(np.linalg.norm(axis))
    along = np.asarray(axis, np.float32) / length if length > 1e-9 else np.array([0, 0, 1], dtype=np.float32)
    first = np.cross(along, np.eye(3, dtype=np.float32)[np.argmin(np.abs(along))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(along, first), along], axis=1)


def _stamp(
    pixels: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    places: np.ndarray,
    each: np.ndarray,
    thickness: int,
) -> None:
    """Colour a disc of ``thickness`` pixels around each place that nothing hides."""
    with np.errstate(invalid="ignore"):
        column, row, distance = camera.project(places)
        usable = np.isfinite(distance) & (distance > 1e-3) & (np.abs(column) < 1e6) & (np.abs(row) < 1e6)
    order = np.flatnonzero(usable)[np.argsort(-distance[usable], kind="stable")]
    column, row = np.floor(column[order]).astype(int), np.floor(row[order]).astype(int)
    distance, each = distance[order], each[order]
    reach = np.arange(thickness) - (thickness - 1) // 2
    for down in reach:
        for across in reach:
            if down**2 + across**2 > (thickness / 2) ** 2 + 0.5:
                continue
            r, c = row + down, column + across
            inside = (r >= 0) & (r < camera.height) & (c >= 0) & (c < camera.width)
            inside[inside] = distance[inside] < depth[r[inside], c[inside]] + 0.02
            pixels[r[inside], c[inside]] = each[inside]
