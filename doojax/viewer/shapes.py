"""Curves and triangle meshes of what is shown; pure numpy."""

import numpy as np
from jaxtyping import Float, Integer

from doojax.types import ShapeKind

Mesh = tuple[Float[np.ndarray, "_ 3"], Integer[np.ndarray, "_ 3"]]  # vertices, faces
SIDES = 10  # of a tube
BETWEEN = 4  # pieces that a smooth curve cuts each segment into


def extended(points: Float[np.ndarray, "*b N 3"], length: float) -> Float[np.ndarray, "*b N 3"]:
    """The curve with its first and last point moved outwards by ``length`` (m), along the end segments.

    A rope's points are its links' centres; the rope itself goes on for half a link.
    """
    points = np.array(points, dtype=np.float32)
    if points.shape[-2] < 2:
        return points
    for end, inner in ((0, 1), (-1, -2)):
        step = points[..., end, :] - points[..., inner, :]
        points[..., end, :] += length * step / np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-9)
    return points


def smooth(points: Float[np.ndarray, "N 3"], between: int = BETWEEN) -> Float[np.ndarray, "K 3"]:
    """A Catmull-Rom curve through ``points``, which are among its (N - 1) between + 1 points."""
    if len(points) < 3:
        return points
    before, after = 2 * points[:1] - points[1:2], 2 * points[-1:] - points[-2:-1]
    padded = np.concatenate([before, points, after])
    a, b, c, d = padded[:-3], padded[1:-2], padded[2:-1], padded[3:]
    t = np.linspace(0, 1, between, endpoint=False)[None, :, None]
    a, b, c, d = (control[:, None] for control in (a, b, c, d))
    curve = b + t * (c - a) / 2 + t**2 * (a - 2.5 * b + 2 * c - d / 2) + t**3 * (1.5 * (b - c) + (d - a) / 2)
    return np.concatenate([curve.reshape(-1, 3), points[-1:]]).astype(points.dtype)


def tube(points: Float[np.ndarray, "N 3"], radius: float, sides: int = SIDES) -> Mesh:
    """A smooth tube with round ends along ``points``; as many vertices for every curve of N points."""
    curve = smooth(np.asarray(points, dtype=np.float64))
    steps = np.diff(curve, axis=0)
    directions = steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9)
    tangents = np.concatenate([directions[:1], directions[:-1] + directions[1:], directions[-1:]])
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    normals = _carried_normals(tangents)
    binormals = np.cross(tangents, normals)

    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    around = np.cos(angle)[:, None] * normals[:, None] + np.sin(angle)[:, None] * binormals[:, None]
    cap = np.array([np.pi / 2, np.pi / 3, np.pi / 6])  # from the pole to the rim of an end's hemisphere
    first = _cap(curve[0], -tangents[0], around[0], radius, cap)
    last = _cap(curve[-1], tangents[-1], around[-1], radius, cap[::-1])
    rings = np.concatenate([first, curve[:, None] + radius * around, last])
    return rings.reshape(-1, 3).astype(np.float32), _ring_faces(len(rings), sides)


def _carried_normals(tangents: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
    """Unit normals that turn as little as possible from one point to the next, lest a tube be twisted."""
    normal = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    normals = np.empty_like(tangents)
    for i, tangent in enumerate(tangents):
        normal = normal - (normal @ tangent) * tangent
        normal /= max(float(np.sqrt(normal @ normal)), 1e-9)
        normals[i] = normal
    return normals


def _cap(
    centre: Float[np.ndarray, "3"],
    outward: Float[np.ndarray, "3"],
    around: Float[np.ndarray, "S 3"],
    radius: float,
    elevation: Float[np.ndarray, "E"],
) -> Float[np.ndarray, "E S 3"]:
    up, out = np.sin(elevation)[:, None, None], np.cos(elevation)[:, None, None]
    return centre + radius * (up * outward + out * around)


def _ring_faces(rings: int, sides: int) -> Integer[np.ndarray, "_ 3"]:
    ring, side = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    a, b = ring * sides + side, ring * sides + (side + 1) % sides
    faces = np.stack([a, b, a + sides, b, b + sides, a + sides], axis=-1)
    return faces.reshape(-1, 3).astype(np.uint32)


def box(half_size: Float[np.ndarray, "3"]) -> Mesh:
    """A box around the origin."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half_size
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in squares for triangle in ((a, b, c), (a, c, d))]
    return corners.astype(np.float32), np.array(faces, dtype=np.uint32)


def lathe(profile: Float[np.ndarray, "K 2"], sides: int = 32) -> Mesh:
    """The body that (radius, height) points describe when turned about z; upwards on the outside."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = np.empty((len(profile), sides, 3))
    rings[..., :2] = profile[:, :1, None] * circle
    rings[..., 2] = profile[:, 1:]
    return rings.reshape(-1, 3).astype(np.float32), _ring_faces(len(profile), sides)


def shape(kind: int, half_size: Float[np.ndarray, "3"]) -> Mesh:
    """The mesh of one obstacle primitive in its own frame."""
    radius, height = float(half_size[0]), float(half_size[2])
    if kind == ShapeKind.BOX:
        return box(half_size)
    if kind == ShapeKind.CYLINDER:
        return lathe(np.array([[0, -height], [radius, -height], [radius, height], [0, height]]))
    return capsule(radius, height, rings=6, sides=32)


def capsule(radius: float, height: float, rings: int = 4, sides: int = SIDES) -> Mesh:
    """Around the origin, along z; ``height`` is half the length of its straight part, ``rings`` its caps'."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 2 * rings)
    profile = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    profile[:rings, 1] -= height
    profile[rings:, 1] += height
    return lathe(profile, sides)


def sphere(radius: float = 1.0, sides: int = 12) -> Mesh:
    """A ball around the origin."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    return lathe(radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1), sides)


def cone(sides: int = 3) -> Mesh:
    """The side of a cone without a base, from a unit circle around the origin to (0, 0, 1)."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    side = np.arange(sides)
    faces = np.stack([side, (side + 1) % sides, np.full(sides, sides)], axis=-1)
    return np.append(circle, [[0, 0, 1]], axis=0).astype(np.float32), faces.astype(np.uint32)


def turns_from_z(directions: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 4"]:
    """Shortest turns, as unit quaternions (w, x, y, z), of the z axis to unit vectors."""
    x, y, z = directions.T
    turns = np.stack([1 + z, -y, x, 0 * z], axis=-1)
    turns[z < -1 + 1e-6] = [0, 1, 0, 0]
    return turns / np.linalg.norm(turns, axis=-1, keepdims=True)
