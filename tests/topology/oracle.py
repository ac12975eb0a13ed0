"""The slow way to linking numbers and distances, in double precision: formulas that doojax does not use.

The linking number of two polylines is the signed area, over 4 pi, that the directions from the second to the
first cover on the unit sphere. Two segments cover the solid angle of the parallelogram of their differences.
"""

import numpy as np


def oracle_linking_number(first, second) -> int:
    first, second = np.asarray(first, float), np.asarray(second, float)
    a, u = first[:-1, None], np.diff(first, axis=0)[:, None]
    b, v = second[None, :-1], np.diff(second, axis=0)[None]
    near, far = a - b, a - b + u - v  # opposite corners of the parallelogram
    covered = solid_angles(near, near - v, far) + solid_angles(near, far, near + u)
    turns = covered.sum() / (4 * np.pi)
    assert abs(turns - round(turns)) < 1e-3, f"the oracle itself is unsure: {turns}"
    return round(turns)


def solid_angles(p, q, r):
    """Signed solid angles of triangles seen from the origin (van Oosterom and Strackee, 1983)."""
    dot = lambda x, y: np.sum(x * y, axis=-1)  # noqa: E731
    i, j, k = (np.linalg.norm(x, axis=-1) for x in (p, q, r))
    volume = dot(p, np.cross(q, r))
    return 2 * np.arctan2(volume, i * j * k + dot(p, q) * k + dot(q, r) * i + dot(r, p) * j)


def oracle_margin(first, second) -> float:
    """Least distance: between two segments at inner points of both, or from a vertex to a segment."""
    first, second = np.asarray(first, float), np.asarray(second, float)
    a, u = first[:-1, None], np.diff(first, axis=0)[:, None]
    b, v = second[None, :-1], np.diff(second, axis=0)[None]
    to_first = point_to_segments(second[None], a, u)
    to_second = point_to_segments(first[:, None], b, v)
    normal = np.cross(u, v)
    square = np.sum(normal**2, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.sum(np.cross(b - a, v) * normal, axis=-1) / square
        t = np.sum(np.cross(b - a, u) * normal, axis=-1) / square
        apart = np.abs(np.sum((b - a) * normal, axis=-1)) / np.sqrt(square)
    inner = (s > 0) & (s < 1) & (t > 0) & (t < 1)
    return min(to_first.min(), to_second.min(), np.where(inner, apart, np.inf).min())


def point_to_segments(point, start, step):
    square = np.sum(step**2, axis=-1)
    along = np.sum((point - start) * step, axis=-1) / np.where(square > 0, square, 1)
    return np.linalg.norm(point - start - np.clip(along, 0, 1)[..., None] * step, axis=-1)
