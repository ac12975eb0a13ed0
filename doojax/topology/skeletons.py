"""Skeletons: the obstacle loops that a signature counts passages through.

By hand (`make_skeleton`, with `rectangle` for frames), or found in a solid: `obstacle_skeleton` for boxes,
capsules and cylinders, `mesh_skeleton` for a mesh. The latter two sample the solid on a grid, where a voxel
counts if its centre lies within half a voxel's diagonal of the solid, and fill cavities. They then guarantee:

- as many loops as the voxel solid has independent handles (its first Betti number), each through one of them
  or several, and together a basis: no handle is missed and none is counted twice;
- loops are closed and lie in the voxel solid, up to half a voxel at their corners. So a curve that keeps two
  voxels away from the obstacles is linked with a loop just as with the handle itself, wherever the loop runs;
- holes that are narrower than about two voxels may close; handles of the true solid otherwise correspond to
  those of the voxel solid.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from doojax.geometry import Grid, fill_mesh_grid, grid_covering, occupancy, quaternion_to_matrix
from doojax.geometry.mesh_parts import check_is_mesh
from doojax.geometry.rounding import require_digits, rounding
from doojax.topology.linking import Points, check_loop
from doojax.topology.thinning import handle_loops
from doojax.types import Obstacles, ShapeKind

if TYPE_CHECKING:
    from trimesh import Trimesh
else:
    Trimesh = Any  # trimesh is not loaded before a mesh exists

_MOST_VOXELS = 5_000_000
_HALF_DIAGONAL = 3**0.5 / 2


class Skeleton(eqx.Module):
    """S obstacle loops of at most M points; `make_skeleton` checks and pads them."""

    loops: Float[Array, "*b S M 3"]  # closed, padded by repeating the last point; world frame, metres
    active: Bool[Array, "*b S"]  # a loop that is not active counts as never passed through
    names: tuple[str, ...] = eqx.field(static=True)


def make_skeleton(loops: Mapping[str, Points]) -> Skeleton:
    """A skeleton from named loops, each [points, 3] in metres with its first point repeated at its end.

    Raises:
        ValueError: naming the loop: it is open, has fewer than three points, repeats one, is not finite, or
            is so far from the origin that float32 would lose its digits.
    """
    checked = [check_loop(points, f"skeleton loop {name!r}") for name, points in loops.items()]
    for name, loop in zip(loops, checked, strict=True):
        require_digits(
            f"skeleton loop {name!r}",
            "subtract a common origin, such as the robot's base, from all loops and from the rope, the base "
            "and the paths, in numpy.float64",
            loop,
        )
    longest = max(map(len, checked), default=4)
    padded = [np.pad(loop, ((0, longest - len(loop)), (0, 0)), mode="edge") for loop in checked]
    points = np.reshape(padded, (len(checked), longest, 3))
    return Skeleton(jnp.asarray(points, float), jnp.ones(len(checked), bool), tuple(loops))


def rectangle(centre: Points, half_across: Points, half_up: Points) -> Float[np.ndarray, "5 3"]:
    """The loop around a frame: centre and vectors from it to the middles of two adjacent sides, metres.

    It turns from the first vector to the second, so that its field passes through it along their cross
    product.
    """
    centre, across, up = (np.asarray(vector, float) for vector in (centre, half_across, half_up))
    if any(vector.shape != (3,) for vector in (centre, across, up)):
        raise ValueError(
            f"centre {centre}, half_across {across}, half_up {up}: expected three vectors of three numbers"
        )
    return np.array([centre + i * across + j * up for i, j in [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]])


def obstacle_skeleton(obstacles: Obstacles, resolution: float) -> Skeleton:
    """Loops through the handles of the union of a scene's obstacles, such as frames made of boxes.

    What is guaranteed, see the module. Cost: about 20 microseconds per voxel of the obstacles.

    Args:
        obstacles: one set; those that are not active are left out.
        resolution: edge of a voxel, metres; at most a third of the narrowest hole.

    Raises:
        ValueError: no obstacle is active, the grid would exceed five million voxels, or the obstacles are so
            far from the origin that their coordinates are rounded to more than a tenth of a voxel.
    """
    active = np.asarray(obstacles.active)
    if not active.any():
        raise ValueError("no obstacle is active, so there is no skeleton; make_skeleton({}) is the empty one")
    extent = np.abs(quaternion_to_matrix(obstacles.quaternion)) @ np.asarray(obstacles.half_size)[..., None]
    round_ends = np.where(obstacles.kind == ShapeKind.CAPSULE, obstacles.half_size[:, 0], 0)
    reach = (extent[..., 0] + round_ends[:, None])[active] + resolution
    centre = np.asarray(obstacles.centre)[active]
    lost = rounding(centre, own=True)
    if lost > resolution / 10:
        raise ValueError(
            f"the obstacles' centres, up to {np.abs(centre).max():.9g} m from the origin, are rounded to "
            f"{lost:.1g} m in {centre.dtype}, too coarse for voxels of {resolution} m: subtract a common "
            "origin in numpy.float64 before the obstacles are made"
        )
    low, high = (centre - reach).min(axis=0), (centre + reach).max(axis=0)
    grid = grid_covering(tuple(low.tolist()), tuple(high.tolist()), resolution)
    if math.prod(grid.shape) > _MOST_VOXELS:
        raise ValueError(
            f"a grid of {' x '.join(map(str, grid.shape))} voxels is beyond {_MOST_VOXELS}: increase "
            f"resolution ({resolution} m), or leave out what has no handles, such as a floor"
        )
    across = jnp.array([resolution, 0, 0])
    slab = eqx.filter_jit(occupancy)
    slabs = [
        slab(obstacles, Grid(grid.origin + x * across, resolution, (1, *grid.shape[1:])))
        for x in range(grid.shape[0])
    ]
    return _skeleton_of(np.concatenate(slabs), low + resolution / 2, resolution)


def mesh_skeleton(mesh: Trimesh, resolution: float) -> Skeleton:
    """Loops through the handles of a closed mesh, such as a mug or a bicycle frame.

    What is guaranteed, see the module. Cost: `doojax.geometry.fill_mesh_grid`, then 20 microseconds per voxel
    of the solid.

    Args:
        mesh: a watertight `trimesh.Trimesh`, metres.
        resolution: edge of a voxel, metres; at most a third of the narrowest hole.

    Raises:
        ValueError: as `fill_mesh_grid` does, for a mesh that is not closed, or too fine a grid; or the mesh
            is so far from the origin that float32 would lose the digits of its loops.
    """
    check_is_mesh(mesh)
    require_digits(
        "the mesh",
        "move it with mesh.apply_translation(-mesh.centroid), and subtract the same from all else that is to "
        "be compared with its loops",
        mesh.bounds,
    )
    grid = fill_mesh_grid(mesh, spacing=resolution, padding=2 * resolution)
    solid = np.asarray(grid.values) <= _HALF_DIAGONAL * resolution
    first_centre = np.asarray(grid.origin, np.float64) + np.asarray(grid.remainder, np.float64)
    return _skeleton_of(solid, first_centre, resolution)


def _skeleton_of(
    solid: Bool[np.ndarray, "X Y Z"], first_centre: Float[np.ndarray, "3"], resolution: float
) -> Skeleton:
    loops = {}
    for place, path in enumerate(handle_loops(solid)):
        corners = first_centre + resolution * _tightened(path, solid)
        loops[f"handle{place}"] = np.concatenate([corners, corners[:1]])
    return make_skeleton(loops)


def _tightened(path: Int[np.ndarray, "n 3"], solid: Bool[np.ndarray, "X Y Z"]) -> Int[np.ndarray, "_ 3"]:
    """A closed path of voxels with fewer corners, to which it can be moved without leaving the solid."""
    while True:
        corners = [0]
        while corners[-1] < len(path):
            end = corners[-1] + 1
            while end < len(path) and _is_inside(path[[corners[-1], end, (end + 1) % len(path)]], solid):
                end += 1
            corners.append(end)
        # The last corner is the first again; begin the next round half-way, so that it may go as well.
        shorter = np.roll(path[corners[:-1]], len(corners) // 2, axis=0)
        if len(shorter) == len(path) or len(shorter) <= 3:
            return path if len(shorter) < 3 else shorter
        path = shorter


def _is_inside(triangle: Int[np.ndarray, "3 3"], solid: Bool[np.ndarray, "X Y Z"]) -> bool:
    """Do all voxels belong to the solid that a triangle passes, by samples at most half a voxel apart?"""
    origin, one, other = triangle[0], triangle[1] - triangle[0], triangle[2] - triangle[0]
    steps = np.linspace(0, 1, 2 + 2 * int(np.abs([one, other, one - other]).max()))
    s, t = (grid.ravel()[:, None] for grid in np.meshgrid(steps, steps))
    places = np.rint(origin + s * (one + t * (other - one))).astype(int)
    return bool(solid[tuple(places.T)].all())
