"""The slow way to linking numbers and distances, in double precision: formulas that doojax does not use.

The linking number of two polylines is the signed area, over 4 pi, that the directions from the second to the
first cover on the unit sphere. Two segments cover the solid angle of the parallelogram of their differences.
Leading axes are batch axes.
"""

import numpy as np


def oracle_linking_number(first, second):
    a, u, b, v = segments(first, second)
    near, far = a - b, a - b + u - v  # opposite corners of the parallelogram
    covered = solid_angles(near, near - v, far) + solid_angles(near, far, near + u)
    turns = covered.sum(axis=(-2, -1)) / (4 * np.pi)
    return np.rint(turns).astype(int), np.abs(turns - np.rint(turns))


def segments(first, second):
    """Starts and steps of the segments of both, such that pairs of them broadcast."""
    first, second = np.asarray(first, float), np.asarray(second, float)
    return (
        first[..., :-1, None, :],
        np.diff(first, axis=-2)[..., None, :],
        second[..., None, :-1, :],
        np.diff(second, axis=-2)[..., None, :, :],
    )


def solid_angles(p, q, r):
    """Signed solid angles of triangles seen from the origin (van Oosterom and Strackee, 1983)."""
    i, j, k = (np.sqrt(dot(x, x)) for x in (p, q, r))
    volume = dot(p, np.cross(q, r))
    return 2 * np.arctan2(volume, i * j * k + dot(p, q) * k + dot(q, r) * i + dot(r, p) * j)


def oracle_margin(first, second):
    """Least distance: between two segments at inner points of both, or from a vertex to a segment."""
    a, u, b, v = segments(first, second)
    normal = np.cross(u, v)
    square = dot(normal, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = dot(np.cross(b - a, v), normal) / square
        t = dot(np.cross(b - a, u), normal) / square
        apart = np.abs(dot(b - a, normal)) / np.sqrt(square)
    inner = (s > 0) & (s < 1) & (t > 0) & (t < 1)
    to_first, to_second = point_to_segments(b, a, u), point_to_segments(a, b, v)
    return np.minimum(np.minimum(to_first, to_second), np.where(inner, apart, np.inf)).min(axis=(-2, -1))


def point_to_segments(point, start, step):
    square = dot(step, step)
    along = np.clip(dot(point - start, step) / np.where(square > 0, square, 1), 0, 1)
    gap = point - start - along[..., None] * step
    return np.sqrt(dot(gap, gap))


def dot(x, y):
    return np.sum(x * y, axis=-1)
