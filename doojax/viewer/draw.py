"""A `Drawing` on a viser scene: only what changed travels to the page."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import viser
from jaxtyping import Float, UInt8

from doojax.experiments.drawing import Colour
from doojax.types import Obstacles, ShapeKind
from doojax.viewer import colours as palette
from doojax.viewer import shapes
from doojax.viewer.episodes import rotation_matrices
from doojax.viewer.shapes import shape as primitive

Colours = Colour | UInt8[np.ndarray, "K 3"]
Anchor = Literal["top-left", "top-right", "bottom-left", "bottom-right"]
FEW = 8  # balls that are nodes of their own


class Pieces:
    """Meshes that move: the page shows that in the frame in which it arrives.

    New vertices, or places in a batch, are seen only in the frame after that.
    """

    def __init__(self, meshes: Sequence[viser.MeshHandle]):
        """Take the scene's meshes over."""
        self._meshes = meshes

    def move(
        self, positions: Float[np.ndarray, "K 3"], quaternions: Float[np.ndarray, "K 4"] | None = None
    ) -> None:
        """Put each mesh at another position (m), turned by another quaternion (w, x, y, z) if given."""
        for mesh, position in zip(self._meshes, positions, strict=True):
            mesh.position = position
        for mesh, quaternion in zip(self._meshes, () if quaternions is None else quaternions, strict=False):
            mesh.wxyz = quaternion

    def paint(self, colours: UInt8[np.ndarray, "K 3"]) -> None:
        """Give each mesh its colour."""
        for mesh, colour in zip(self._meshes, colours.tolist(), strict=True):
            if tuple(mesh.color) != tuple(colour):
                mesh.color = tuple(colour)

    def remove(self) -> None:
        """Take them away."""
        for mesh in self._meshes:
            mesh.remove()


class SceneDrawing:
    """Implements `doojax.experiments.drawing.Drawing` below one node of a viser scene.

    What is drawn again at another place sends its new places or vertices, nothing else.
    """

    def __init__(self, scene: viser.SceneApi, root: str = ""):
        """Draw below the scene node ``root``, in its frame; "" is the world."""
        self._scene = scene
        self._root = root
        self._handles: dict[str, Any] = {}
        self._about: dict[str, tuple] = {}  # what a handle cannot change: if it differs, a new one is made

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
        if not np.isfinite(points).all():
            self.remove(name)
            return
        if opacity == 1:
            self._rope_of_pieces(name, points, radius, colour)
            return
        vertices, faces = shapes.tube(points, radius)  # in one, because pieces would be seen in each other
        if self._stays(name, ("rope", len(vertices), colour, opacity)):
            self._handles[name].vertices = vertices
        else:
            self._keep(
                name,
                self._scene.add_mesh_simple(self._path(name), vertices, faces, color=colour, opacity=opacity),
            )

    def spheres(
        self,
        name: str,
        centres: Float[np.ndarray, "K 3"],
        *,
        radius: float,
        colours: Colours,
        opacity: float = 1.0,
    ) -> None:
        """See `Drawing.spheres`."""
        centres = np.asarray(centres, dtype=np.float32)
        each = np.broadcast_to(np.asarray(colours, dtype=np.uint8), centres.shape)
        known = np.isfinite(centres).all(-1)
        centres, each = centres[known], each[known]
        if not len(centres):
            self.remove(name)
        elif len(centres) <= FEW:
            self._few_spheres(name, centres, radius, each, opacity)
        elif self._stays(name, ("spheres", len(centres), radius, opacity)):
            self._handles[name].batched_positions = centres
            self._handles[name].batched_colors = linear(each)
        else:
            vertices, faces = shapes.sphere(radius)
            turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(centres), 1))
            handle = self._scene.add_batched_meshes_simple(
                self._path(name),
                vertices,
                faces,
                turns,
                centres,
                batched_colors=linear(each),
                opacity=opacity if opacity < 1 else None,
                lod="off",
                cast_shadow=opacity == 1,
            )
            self._keep(name, handle)

    def points(self, name: str, points: Float[np.ndarray, "K 3"], *, size: float, colours: Colours) -> None:
        """See `Drawing.points`."""
        points = np.asarray(points, dtype=np.float32)
        each = np.broadcast_to(np.asarray(colours, dtype=np.uint8), points.shape)
        self._stays(name, ())
        handle = self._scene.add_point_cloud(
            self._path(name),
            points,
            each,
            point_size=size,
            point_shape="circle",
            precision="float32",
            point_shading="flat",
        )
        self._keep(name, handle)

    def lines(
        self,
        name: str,
        segments: Float[np.ndarray, "K 2 3"],
        *,
        width: float,
        colours: Colours,
    ) -> None:
        """See `Drawing.lines`."""
        segments = np.asarray(segments, dtype=np.float32)
        each = np.broadcast_to(np.asarray(colours, dtype=np.uint8), (len(segments), 3))
        known = np.isfinite(segments).all((1, 2))
        segments, each = segments[known], np.repeat(linear(each[known])[:, None], 2, axis=1)
        if not len(segments):
            self.remove(name)
        elif self._stays(name, ("lines", width)):
            self._handles[name].points = segments
            self._handles[name].colors = each
        else:
            handle = self._scene.add_line_segments(
                self._path(name), segments, each, thickness=width, thickness_units="screen"
            )
            self._keep(name, handle)

    def cones(
        self, name: str, segments: Float[np.ndarray, "K 2 3"], *, radius: float, colours: Colours
    ) -> None:
        """See `Drawing.cones`; one batched mesh, because tens of thousands of lines are slower to draw."""
        segments = np.asarray(segments, dtype=np.float32)
        each = np.broadcast_to(np.asarray(colours, dtype=np.uint8), (len(segments), 3))
        lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1)
        known = np.isfinite(lengths) & (lengths > 0)
        segments, each, lengths = segments[known], each[known], lengths[known]
        self.remove(name)
        if not len(segments):
            return
        vertices, faces = shapes.cone()
        handle = self._scene.add_batched_meshes_simple(
            self._path(name),
            vertices,
            faces,
            shapes.turns_from_z((segments[:, 1] - segments[:, 0]) / lengths[:, None]),
            segments[:, 0],
            batched_scales=np.stack([np.full_like(lengths, radius)] * 2 + [lengths], axis=1),
            batched_colors=linear(each),
            flat_shading=True,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._keep(name, handle)

    def obstacles(self, name: str, obstacles: Obstacles, *, colour: Colour, opacity: float = 1.0) -> None:
        """See `Drawing.obstacles`; a table top is drawn in its own colour."""
        kind, centre, half_size, active = (
            np.asarray(getattr(obstacles, field)) for field in ("kind", "centre", "half_size", "active")
        )
        turns = rotation_matrices(np.asarray(obstacles.quaternion))
        by_colour: dict[Colour, list[shapes.Mesh]] = {}
        for i in np.flatnonzero(active):
            vertices, faces = primitive(int(kind[i]), half_size[i])
            shown = palette.obstacle_colour(half_size[i]) if colour == palette.OBSTACLE else colour
            by_colour.setdefault(shown, []).append((vertices @ turns[i].T + centre[i], faces))
        self.remove(name)
        for number, (shown, meshes) in enumerate(by_colour.items()):
            vertices, faces = merged(meshes)
            handle = self._scene.add_mesh_simple(
                self._path(f"{name}/{number}"),
                vertices,
                faces,
                color=shown,
                opacity=opacity if opacity < 1 else None,
                flat_shading=True,
                side="double" if opacity < 1 else "front",
            )
            self._keep(f"{name}/{number}", handle)

    def bodies(self, name: str, shapes: Obstacles, *, colours: Colours, opacity: float = 1.0) -> None:
        """See `Drawing.bodies`; where only places and colours are others, no mesh is sent again."""
        kind, centre, turn, half_size, active = (
            np.asarray(getattr(shapes, field))
            for field in ("kind", "centre", "quaternion", "half_size", "active")
        )
        each = np.broadcast_to(np.asarray(colours, dtype=np.uint8), (len(kind), 3))[active]
        kind, centre, turn, half_size = (values[active] for values in (kind, centre, turn, half_size))
        if not len(kind):
            self.remove(name)
            return
        if not self._stays(name, ("bodies", kind.tobytes(), half_size.tobytes(), opacity)):
            meshes = [
                self._scene.add_mesh_simple(
                    self._path(f"{name}/{number}"),
                    *primitive(int(kind[number]), half_size[number]),
                    color=tuple(each[number].tolist()),
                    opacity=opacity if opacity < 1 else None,
                    flat_shading=bool(kind[number] != ShapeKind.CAPSULE),
                )
                for number in range(len(kind))
            ]
            self._keep(name, Pieces(meshes))
        self._handles[name].paint(each)
        self._handles[name].move(centre, turn)

    def axes(
        self,
        name: str,
        position: Float[np.ndarray, "3"],
        quaternion: Float[np.ndarray, "4"],
        *,
        length: float = 0.1,
    ) -> None:
        """See `Drawing.axes`."""
        self._stays(name, ())
        handle = self._scene.add_frame(
            self._path(name),
            position=np.asarray(position, dtype=float),
            wxyz=np.asarray(quaternion, dtype=float),
            axes_length=length,
            axes_radius=length / 30,
            origin_radius=length / 20,
        )
        self._keep(name, handle)

    def text(
        self, name: str, text: str, position: Float[np.ndarray, "3"], anchor: Anchor = "top-left"
    ) -> None:
        """See `Drawing.text`; ``anchor`` is the corner of the words that is at the place."""
        if self._stays(name, ("text", anchor)):
            self._handles[name].text = text
            self._handles[name].position = np.asarray(position, dtype=float)
        else:
            place = np.asarray(position, dtype=float)
            self._keep(name, self._scene.add_label(self._path(name), text, position=place, anchor=anchor))

    def remove(self, name: str) -> None:
        """See `Drawing.remove`."""
        for key in [key for key in self._handles if key == name or key.startswith(f"{name}/")]:
            self._about.pop(key, None)
            self._handles.pop(key).remove()

    def clear(self) -> None:
        """Remove everything that was drawn."""
        for key in list(self._handles):
            self.remove(key)

    def _rope_of_pieces(
        self, name: str, points: Float[np.ndarray, "N 3"], radius: float, colour: Colour
    ) -> None:
        """Straight pieces with round ends, short enough to look like a curve."""
        curve = shapes.smooth(np.asarray(points, dtype=np.float64))
        steps = np.diff(curve, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        quaternions = shapes.turns_from_z(steps / np.maximum(lengths, 1e-9)[:, None])
        length, kept = float(lengths.mean()), self._about.get(name, ())
        if kept[:1] == ("pieces",) and abs(kept[1] - length) < radius / 2:  # round ends hide as much
            length = kept[1]
        if not self._stays(name, ("pieces", length, len(steps), radius, colour)):
            mesh = shapes.capsule(radius, length / 2)
            self._keep(name, self._pieces(name, mesh, np.tile(np.array(colour, np.uint8), (len(steps), 1))))
        self._handles[name].move((curve[1:] + curve[:-1]) / 2, quaternions)

    def _few_spheres(
        self,
        name: str,
        centres: Float[np.ndarray, "K 3"],
        radius: float,
        colours: UInt8[np.ndarray, "K 3"],
        opacity: float,
    ) -> None:
        if not self._stays(name, ("few", len(centres), radius, opacity)):
            self._keep(name, self._pieces(name, shapes.sphere(radius), colours, opacity))
        self._handles[name].paint(colours)
        self._handles[name].move(centres)

    def _pieces(
        self, name: str, mesh: shapes.Mesh, colours: UInt8[np.ndarray, "K 3"], opacity: float = 1.0
    ) -> Pieces:
        """As many of one mesh as there are colours, all at the origin."""
        return Pieces(
            [
                self._scene.add_mesh_simple(
                    self._path(f"{name}/{number}"),
                    *mesh,
                    color=tuple(colour.tolist()),
                    opacity=opacity if opacity < 1 else None,
                )
                for number, colour in enumerate(colours)
            ]
        )

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}"

    def _stays(self, name: str, about: tuple) -> bool:
        """Whether the handle of this name can go on; if not, it is taken away."""
        if about and self._about.get(name) == about:
            return True
        self.remove(name)
        self._about[name] = about
        return False

    def _keep(self, name: str, handle: Any) -> None:
        self._handles[name] = handle


def linear(colours: UInt8[np.ndarray, "*k 3"]) -> UInt8[np.ndarray, "*k 3"]:
    """Colours as viser takes them where each of many things has its own: without the gamma of sRGB."""
    part = colours / 255
    curved = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return (255 * curved).round().astype(np.uint8)


def merged(meshes: list[shapes.Mesh]) -> shapes.Mesh:
    """Several meshes as one, which is one object to draw."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in meshes[:-1])])
    vertices = np.concatenate([vertices for vertices, _ in meshes]).astype(np.float32)
    faces = np.concatenate([faces + offset for (_, faces), offset in zip(meshes, first, strict=True)])
    return vertices, faces.astype(np.uint32)
