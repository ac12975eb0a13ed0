"""Pictures of boxes, capsules and cylinders by exact ray casting in numpy: no window, no GPU, no browser.

A primitive is intersected only with the rays of the rectangle that it covers. The same code looks from the
light: what the light does not see lies in shadow.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from doojax.types import ShapeKind

Vector = Float[np.ndarray, "3"]
NOTHING = np.float32(1e6)  # metres to what is not there


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from. ``span``: metres from top to bottom in a parallel view."""

    eye: Vector  # in a parallel view, any point in front of everything
    axes: Float[np.ndarray, "3 3"]  # rows: right, up, forward
    width: int  # pixels
    height: int
    span: float | None  # None: a perspective view
    tangent: float = 0.32  # of half the vertical angle of a perspective view

    @classmethod
    def looking(
        cls, eye: Vector, target: Vector, up: Vector, width: int, height: int, span: float | None
    ) -> "Camera":
        """The camera at ``eye`` that has ``target`` in the middle of its picture."""
        forward = np.asarray(target, dtype=np.float64) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(right, forward), forward])
        return cls(np.asarray(eye, np.float32), axes.astype(np.float32), width, height, span)

    @property
    def scale(self) -> float:
        """Pixels per metre (parallel), or per metre at a distance of one metre (perspective)."""
        return self.height / (2 * self.tangent if self.span is None else self.span)

    def project(
        self, points: Float[np.ndarray, "*k 3"]
    ) -> tuple[Float[np.ndarray, "*k"], Float[np.ndarray, "*k"], Float[np.ndarray, "*k"]]:
        """Column and row in pixels, and depth along the viewing direction, metres."""
        local = (points - self.eye) @ self.axes.T
        depth = local[..., 2]
        scale = self.scale / np.maximum(depth, 1e-6) if self.span is None else self.scale
        column, row = self.width / 2 + local[..., 0] * scale, self.height / 2 - local[..., 1] * scale
        return np.asarray(column), np.asarray(row), np.asarray(depth)

    def rays(self, rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions, [h, w, 3] or broadcastable; a direction's depth is one metre."""
        x = (np.arange(columns.start, columns.stop) + 0.5 - self.width / 2) / self.scale
        y = (self.height / 2 - 0.5 - np.arange(rows.start, rows.stop)) / self.scale
        offset = (
            x[None, :, None].astype(np.float32) * self.axes[0]
            + y[:, None, None].astype(np.float32) * self.axes[1]
        )
        if self.span is None:
            return self.eye[None, None], offset + self.axes[2]
        return self.eye + offset, np.broadcast_to(self.axes[2], offset.shape)


@dataclass(frozen=True)
class Solid:
    """A primitive with its place and colour; half_size as `doojax.types.ShapeKind` reads it."""

    kind: int
    centre: Vector
    rotation: Float[np.ndarray, "3 3"]  # columns: the body's axes
    half_size: Vector
    colour: tuple[int, int, int]
    opacity: float = 1.0

    def window(self, camera: Camera) -> tuple[slice, slice] | None:
        """Rows and columns that it may cover; None outside the picture."""
        reach = np.array(self.half_size, dtype=np.float32)
        if self.kind == ShapeKind.CAPSULE:
            reach[2] += reach[0]
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * reach
        column, row, depth = camera.project(self.centre + corners @ self.rotation.T)
        if camera.span is None and (depth < 1e-3).any():
            return slice(0, camera.height), slice(0, camera.width)
        first_row, last_row = np.clip([row.min() - 1, row.max() + 2], 0, camera.height).astype(int)
        first, last = np.clip([column.min() - 1, column.max() + 2], 0, camera.width).astype(int)
        return (
            (slice(first_row, last_row), slice(first, last))
            if last_row > first_row and last > first
            else None
        )

    def hit(self, camera: Camera, rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
        """Depth [h, w] where each ray enters, `NOTHING` where it misses, and the normal [h, w, 3]."""
        origin, direction = camera.rays(rows, columns)
        origin, direction = (origin - self.centre) @ self.rotation, direction @ self.rotation
        meet = {
            ShapeKind.BOX: _meet_box,
            ShapeKind.CAPSULE: _meet_capsule,
            ShapeKind.CYLINDER: _meet_cylinder,
        }
        with np.errstate(divide="ignore", invalid="ignore"):
            depth, normal = meet[ShapeKind(self.kind)](
                origin, direction, np.asarray(self.half_size, np.float32)
            )
        return depth, normal @ self.rotation.T


def _meet_box(origin, direction, half_size):
    safe = np.where(np.abs(direction) < 1e-9, np.float32(1e-9), direction)
    near = (-np.sign(safe) * half_size - origin) / safe
    far = (np.sign(safe) * half_size - origin) / safe
    enter, leave = near.max(-1), far.min(-1)
    normal = -np.sign(safe) * (near == enter[..., None])
    return np.where((enter <= leave) & (enter > 0), enter, NOTHING), normal


def _meet_capsule(origin, direction, half_size):
    radius, half = half_size[0], half_size[2]
    a = (direction[..., :2] ** 2).sum(-1)
    b = (direction[..., :2] * origin[..., :2]).sum(-1)
    c = (origin[..., :2] ** 2).sum(-1) - radius**2
    side = (-b - np.sqrt(b * b - a * c)) / a
    height = origin[..., 2] + side * direction[..., 2]
    on_side = (a > 1e-12) & (np.abs(height) <= half)
    depth = np.where(on_side, side, NOTHING)
    for end in (-half, half) if half else (half,):
        shifted = origin - np.array([0, 0, end], dtype=origin.dtype)
        a3, b3 = (direction**2).sum(-1), (direction * shifted).sum(-1)
        cap = (-b3 - np.sqrt(b3 * b3 - a3 * ((shifted**2).sum(-1) - radius**2))) / a3
        depth = np.fmin(depth, np.where(cap > 0, cap, NOTHING))
    depth = np.where(depth > 0, depth, NOTHING)
    point = origin + depth[..., None] * direction
    axis_point = np.clip(point[..., 2:], -half, half) * np.array([0, 0, 1], dtype=origin.dtype)
    return depth, (point - axis_point) / radius


def _meet_cylinder(origin, direction, half_size):
    radius, half = half_size[0], half_size[2]
    a = (direction[..., :2] ** 2).sum(-1)
    b = (direction[..., :2] * origin[..., :2]).sum(-1)
    c = (origin[..., :2] ** 2).sum(-1) - radius**2
    side = (-b - np.sqrt(b * b - a * c)) / a
    on_side = (side > 0) & (np.abs(origin[..., 2] + side * direction[..., 2]) <= half)
    up = -np.sign(direction[..., 2])
    flat = (up * half - origin[..., 2]) / direction[..., 2]
    place = origin[..., :2] + flat[..., None] * direction[..., :2]
    on_flat = (flat > 0) & ((place**2).sum(-1) <= radius**2)
    depth = np.where(on_side, side, np.where(on_flat, flat, NOTHING))
    normal = np.zeros(np.broadcast_shapes(origin.shape, direction.shape), dtype=np.float32)
    point = origin + depth[..., None] * direction
    normal[..., :2] = np.where(on_side[..., None], point[..., :2] / radius, 0)
    normal[..., 2] = np.where(on_side, 0, up)
    return depth, normal


@dataclass
class Buffers:
    """What a camera sees: depth, surface and whose it is, per pixel."""

    camera: Camera
    depth: Float[np.ndarray, "H W"] = field(init=False)
    normal: Float[np.ndarray, "H W 3"] = field(init=False)
    colour: Float[np.ndarray, "H W 3"] = field(init=False)
    owner: Int[np.ndarray, "H W"] = field(init=False)  # -1 where there is nothing

    def __post_init__(self):
        """Start with an empty view."""
        size = (self.camera.height, self.camera.width)
        self.depth = np.full(size, NOTHING, dtype=np.float32)
        self.normal = np.zeros((*size, 3), dtype=np.float32)
        self.colour = np.zeros((*size, 3), dtype=np.float32)
        self.owner = np.full(size, -1, dtype=np.int32)

    def copy(self) -> "Buffers":
        """Another view of the same, to add to."""
        other = Buffers.__new__(Buffers)
        other.camera = self.camera
        for name in ("depth", "normal", "colour", "owner"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def add(self, solid: Solid, owner: int) -> None:
        """Put a solid where it is the nearest; blend it over what lies behind if it is translucent."""
        window = solid.window(self.camera)
        if window is None:
            return
        depth, normal = solid.hit(self.camera, *window)
        nearer = depth < self.depth[window]
        if solid.opacity < 1:
            blend = self.colour[window]
            blend[nearer] += solid.opacity * (np.array(solid.colour, dtype=np.float32) - blend[nearer])
            return
        self.depth[window][nearer] = depth[nearer]
        self.normal[window][nearer] = normal[nearer]
        self.colour[window][nearer] = solid.colour
        self.owner[window][nearer] = owner

    def positions(self, chosen: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "K 3"]:
        """Where in the world the surfaces of the chosen pixels are."""
        row, column = np.nonzero(chosen)
        camera = self.camera
        x = ((column + 0.5 - camera.width / 2) / camera.scale).astype(np.float32)
        y = ((camera.height / 2 - 0.5 - row) / camera.scale).astype(np.float32)
        depth = self.depth[chosen]
        if camera.span is None:
            x, y = x * depth, y * depth
        return camera.eye + np.stack([x, y, depth], axis=-1) @ camera.axes


def shadow_camera(light: Vector, low: Vector, high: Vector, pixels: int = 768) -> Camera:
    """A parallel view from the light on everything between two corners of the world."""
    middle, reach = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    up = np.array([0.0, 1.0, 0.0]) if abs(light[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    eye = middle + light * reach * 2
    return Camera.looking(eye, middle, up, pixels, pixels, span=2 * reach)


def pixel_and_depth(
    camera: Camera, positions: Float[np.ndarray, "K 3"]
) -> tuple[Int[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    """Index into the flattened picture (its border for what lies outside) and depth of each position."""
    column, row, depth = camera.project(positions)
    column = column.clip(0, camera.width - 1).astype(np.int32)
    row = row.clip(0, camera.height - 1).astype(np.int32)
    return row * camera.width + column, depth
