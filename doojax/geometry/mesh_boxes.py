"""A closed mesh as boxes that cover it closely: what planners, every engine and every file of data know.

A box is cut in two, at the plane that leaves least volume, until no box sticks out of the mesh by more than
is allowed. Each is the smallest box around its share of the solid. That share is spanned by the pieces of
surface in it and by those corners of what was cut that lie inside the mesh.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from doojax.geometry.mesh_parts import solid_parts, winding

if TYPE_CHECKING:
    from scipy.spatial import KDTree
    from trimesh import Trimesh
else:
    KDTree = Trimesh = Any  # neither is loaded before a mesh exists

ROUNDING = 1e-3  # of ``within``, to which corners are rounded, and by which boxes are larger than need be
STEP = 0.25  # of ``within``: between surface samples, and between the points at which a box is checked
COARSE = 0.9  # of ``within``: between points at which a box is looked at before that
_HALF_DIAGONAL = 3**0.5 / 2  # of a cube of edge 1
_MOST_ALONG = 200  # times ``within``, that a mesh is long
_MOST_CUT = 8  # times as many boxes as there may be, before some are joined again
_AT_ONCE = 500_000


class _Piece(NamedTuple):
    box: Float[np.ndarray, "2 3"]  # least and greatest corner
    surface: Float[np.ndarray, "F 3 3"]  # the mesh's triangles, cut off at the box


class _Solid(NamedTuple):
    triangles: Float[np.ndarray, "F 3 3"]  # outward
    samples: KDTree  # on the surface
    within: float


def covering_boxes(mesh: Trimesh, within: float, most: int = 256) -> Float[np.ndarray, "K 2 3"]:
    """Boxes with faces along the mesh's own axes that together contain it.

    Every point of a box is at most ``within`` from the solid, and every point of the solid is in a box. What
    is made of such boxes comes out exact but for a thousandth of ``within``; what is round or askew takes
    many.

    Args:
        mesh: a watertight `trimesh.Trimesh`, metres. Parts may overlap, cavities are kept.
        within: how far (m) boxes may stick out of the mesh.
        most: boxes there may be.

    Returns:
        the least and the greatest corner of each box, mesh frame, metres.

    Raises:
        ValueError: the mesh encloses nothing (the message says what mends it), ``within`` is not positive or
            less than a 200th of the mesh's length, or ``most`` boxes are not enough.
    """
    if not within > 0:
        raise ValueError(
            f"within is {within}, expected how far (m) boxes may stick out of the mesh: more than 0"
        )
    triangles = np.concatenate(solid_parts(mesh))
    longest = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    if longest > _MOST_ALONG * within:
        raise ValueError(
            f"within is {within} m, expected at least {longest / _MOST_ALONG:.2g} m, a {_MOST_ALONG}th of "
            f"the mesh's length of {longest:.3g} m; check that the mesh is in metres"
        )
    grid = ROUNDING * within
    triangles = np.round(triangles / grid) * grid
    solid = _Solid(triangles, _samples(triangles, STEP * within), within)
    corners = triangles.reshape(-1, 3)
    too_many = ValueError(
        f"more than {most} boxes are needed to follow the mesh within {within} m: allow more metres or more "
        "boxes, turn a mesh that lies askew, or leave out what cannot be reached"
    )
    waiting = [_Piece(np.stack([corners.min(0), corners.max(0)]), triangles)]
    done: list[np.ndarray] = []
    while waiting:
        piece = waiting.pop()
        if _fits(solid, piece.box):
            done.append(piece.box)
        else:
            waiting += _halves(solid, piece)
        if len(done) + len(waiting) > _MOST_CUT * most:
            raise too_many
    boxes = _merged(solid, done)
    if len(boxes) > most:
        raise too_many
    return np.stack(boxes) + np.array([[-grid], [grid]])


def _samples(triangles: Float[np.ndarray, "F 3 3"], step: float) -> KDTree:
    """Points on the surface, no place of which is farther than step / sqrt(3) from one."""
    from scipy.spatial import KDTree
    from trimesh.remesh import subdivide_to_size

    corners = triangles.reshape(-1, 3)
    divided = subdivide_to_size(corners, np.arange(len(corners)).reshape(-1, 3), step, max_iter=30)
    return KDTree(divided[0])


def _lattice(box: Float[np.ndarray, "2 3"], step: float) -> list[Float[np.ndarray, "_"]]:
    """Coordinates along each axis, from face to face, at most ``step`` apart."""
    return [
        np.linspace(low, high, int(np.ceil((high - low) / step - 1e-9)) + 1 if high > low else 1)
        for low, high in box.T
    ]


def _outside(solid: _Solid, axes: list[Float[np.ndarray, "_"]]) -> Bool[np.ndarray, "X Y Z"]:
    """At which points of a lattice a box would stick out by more than allowed, or might half a step away.

    Far points that are neighbours lie on one side of the surface, so that one of each group is asked.
    """
    from scipy import ndimage

    shape = tuple(len(one) for one in axes)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # the samples are farther away than the surface, if at all, and corners are rounded: both err to this side
    limit = solid.within * (1 - 4 * ROUNDING - STEP * _HALF_DIAGONAL)
    far = np.concatenate(
        [
            np.isinf(solid.samples.query(points[first : first + _AT_ONCE], distance_upper_bound=limit)[0])
            for first in range(0, len(points), _AT_ONCE)
        ]
    ).reshape(shape)
    labelled: Any = ndimage.label(far)
    groups, count = labelled
    if not count:
        return far
    _, ones = np.unique(groups.reshape(-1), return_index=True)
    of_group = np.concatenate([[False], winding(points[ones[-count:]], solid.triangles) < 0.5])
    return of_group[groups]


def _fits(solid: _Solid, box: Float[np.ndarray, "2 3"]) -> bool:
    """Does no point of the box stick out by more than allowed? A coarse look first, which is often enough."""
    return not any(_outside(solid, _lattice(box, part * solid.within)).any() for part in (COARSE, STEP))


def _halves(solid: _Solid, piece: _Piece) -> Iterator[_Piece]:
    """The two parts of a piece that are cut where least volume remains."""
    step = min(COARSE * solid.within, float(np.ptp(piece.box, axis=0).max()) / 4)
    axes = _lattice(piece.box, step)
    axis, cut = _best_cut(axes, ~_outside(solid, axes))
    # at a corner of the mesh, if there is one as near as the lattice sees: there parts end
    corners = piece.surface[..., axis].reshape(-1)
    low, high = piece.box[:, axis]
    inner = corners[(corners > low) & (corners < high)]
    if len(inner) and np.abs(inner - cut).min() <= 2 * step:
        cut = inner[np.argmin(np.abs(inner - cut))]
    for upper in (False, True):
        cell = piece.box.copy()
        cell[0 if upper else 1, axis] = cut
        surface = cut_off(piece.surface, axis, cut, upper=upper)
        ends = np.stack(np.meshgrid(*cell.T, indexing="ij"), axis=-1).reshape(-1, 3)
        spanning = np.concatenate([surface.reshape(-1, 3), ends[winding(ends, solid.triangles) > 0.25]])
        if len(spanning):
            yield _Piece(np.clip(np.stack([spanning.min(0), spanning.max(0)]), *cell), surface)


def _merged(solid: _Solid, boxes: list[Float[np.ndarray, "2 3"]]) -> list[Float[np.ndarray, "2 3"]]:
    """Fewer boxes: neighbours are joined where one around both sticks out no more than allowed."""
    known = dict(enumerate(boxes))
    refused: set[tuple[int, int]] = set()
    joined = True
    while joined:
        joined = False
        names, corners = list(known), np.stack(list(known.values()))
        low, high = corners[:, 0], corners[:, 1]
        together = np.maximum(high[:, None], high) - np.minimum(low[:, None], low)
        touching = (np.maximum(low[:, None], low) <= np.minimum(high[:, None], high)).all(-1)
        waste = together.prod(-1) - (volume := (high - low).prod(-1))[:, None] - volume
        first, second = np.nonzero(np.triu(touching, 1))
        for at in np.argsort(waste[first, second]):
            pair = names[first[at]], names[second[at]]
            if pair in refused or not (pair[0] in known and pair[1] in known):
                continue
            around = np.stack([low[[first[at], second[at]]].min(0), high[[first[at], second[at]]].max(0)])
            if _fits(solid, around):
                del known[pair[0]], known[pair[1]]
                known[max([*known, *pair]) + 1] = around
                joined = True
            else:
                refused.add(pair)
    return list(known.values())


def _best_cut(axes: list[Float[np.ndarray, "_"]], taken: Bool[np.ndarray, "X Y Z"]) -> tuple[int, float]:
    """Axis and place of the cut after which the boxes around the taken points on either side are smallest."""
    lengths = np.array([one[-1] - one[0] for one in axes])
    found = []
    for axis in range(3):
        for index in range(1, len(axes[axis]) - 1):
            below, above = np.split(taken, [index], axis=axis)
            below = np.concatenate([below, np.take(taken, [index], axis=axis)], axis=axis)
            apart = [*axes[:axis], axes[axis][index:], *axes[axis + 1 :]]
            volume = _volume_around(axes, below) + _volume_around(apart, above)
            off_middle = abs(axes[axis][index] - axes[axis].mean()) / lengths.max()  # decides between equals
            found.append((volume + 1e-3 * lengths.prod() * off_middle, -lengths[axis], axis, index))
    _, _, axis, index = min(found)
    return axis, float(axes[axis][index])


def _volume_around(axes: list[Float[np.ndarray, "_"]], taken: Bool[np.ndarray, "X Y Z"]) -> float:
    """Volume of the box around the taken points of a lattice."""
    volume = 1.0
    for axis, places in enumerate(axes):
        at = np.flatnonzero(taken.any(axis=tuple(other for other in range(3) if other != axis)))
        volume *= float(places[at[-1]] - places[at[0]]) if len(at) else 0.0
    return volume


def cut_off(
    triangles: Float[np.ndarray, "F 3 3"], axis: int, cut: float, *, upper: bool
) -> Float[np.ndarray, "G 3 3"]:
    """What of a solid's surface lies on one side of the plane on which coordinate ``axis`` is ``cut``.

    A triangle in the plane belongs to the side on which the solid is: it faces away from there.
    """
    sign = 1.0 if upper else -1.0
    height = sign * (triangles[..., axis] - cut)
    above = height > 0
    edges = triangles[:, 1:] - triangles[:, :1]
    facing = sign * np.cross(edges[:, 0], edges[:, 1])[:, axis]
    kept = (above.any(1) & (height >= 0).all(1)) | ((height == 0).all(1) & (facing < 0))
    crossing = above.any(1) & (height < 0).any(1)
    cornered, over = triangles[crossing], above[crossing]
    heights = height[crossing]
    lonely = over.sum(1) == 1  # one corner is above; else two are
    first = np.argmax(over == lonely[:, None], axis=1)
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(cornered, order[..., None], 1), 1, 0)
    high_a, high_b, high_c = np.take_along_axis(heights, order, 1).T
    ab = a + (high_a / (high_a - high_b))[:, None] * (b - a)
    ac = a + (high_a / (high_a - high_c))[:, None] * (c - a)
    ab[:, axis] = ac[:, axis] = cut
    pieces = [
        triangles[kept],
        np.stack([a, ab, ac], 1)[lonely],
        np.stack([ab, b, c], 1)[~lonely],
        np.stack([ab, c, ac], 1)[~lonely],
    ]
    return np.concatenate(pieces)
