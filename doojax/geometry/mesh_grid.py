"""Signed distance to a mesh: sampled once on a grid, then interpolated and differentiated like any array."""

import functools
import math
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from doojax.geometry.frames import safe_norm, same_rank
from doojax.geometry.mesh_parts import solid_parts

if TYPE_CHECKING:
    from trimesh import Trimesh
else:
    Trimesh = Any  # trimesh is not loaded before a mesh exists

_MOST_NODES = 20_000_000
_NODES_AT_ONCE = 1024
_THINNEST = 1e-7  # height over longest edge below which a triangle counts as its edges: double precision ends


class MeshGrid(eqx.Module):
    """Signed distances at the nodes of a cubic grid around a mesh, in the mesh's own frame, metres."""

    values: Float[Array, "X Y Z"]
    origin: Float[Array, "3"]  # position of node (0, 0, 0), rounded to the array's precision
    remainder: Float[Array, "3"]  # what rounding took from it: not nothing if the mesh is far from the origin
    spacing: Float[Array, ""]


def fill_mesh_grid(mesh: Trimesh, spacing: float, padding: float) -> MeshGrid:
    """Sample the exact signed distance of a closed mesh on a grid.

    Each node is compared with each triangle, in double precision and wherever the mesh lies: the least
    point-triangle distance, and for the sign the winding number, from the triangles' solid angles. The cost
    is nodes times faces, about 5e7 pairs per second on two CPU cores.

    A mesh may have several parts, wound outward or inward. Where solid parts overlap it is the depth in the
    one entered deepest, as of obstacles (`doojax.geometry.signed_distance`): faces of one part that are
    hidden in another do not count, the sign is that of their union, the depth at most that in their union. A
    part that lies in another and is wound the other way is a cavity. Where one part overlaps itself the sign
    is right and the depth at most the true one.

    Args:
        mesh: a watertight `trimesh.Trimesh`, in metres.
        spacing: distance between nodes, metres.
        padding: least distance from the mesh's bounding box to the border of the grid, metres, not negative.

    Raises:
        ValueError: if the mesh encloses nothing (`doojax.geometry.mesh_parts.solid_parts` says why, and what
            helps), if spacing or padding is out of range, or if the grid would hold more than 20 million
            nodes.
    """
    if not spacing > 0 or not padding >= 0:
        raise ValueError(
            f"spacing {spacing} and padding {padding} (metres): expected a positive and a non-negative number"
        )
    solids = solid_parts(mesh)
    low, high = mesh.bounds[0] - padding, mesh.bounds[1] + padding
    shape = np.ceil((high - low) / spacing - 1e-6).astype(int) + 1  # 1e-6: do not add a node for rounding
    if np.prod(shape.astype(float)) > _MOST_NODES:
        raise ValueError(
            f"a grid of {' x '.join(map(str, shape))} nodes is beyond {_MOST_NODES}: increase spacing "
            f"({spacing} m), or check that the mesh, {np.ptp(mesh.bounds, axis=0)} across, is in metres"
        )
    nodes = np.stack(
        np.meshgrid(*(spacing * np.arange(count) for count in shape), indexing="ij"), axis=-1
    ).reshape(-1, 3)
    with jax.enable_x64(True):  # thin triangles have no normal in single precision
        distances = [
            np.asarray(_distances_to_part(jnp.asarray(nodes), jnp.asarray(triangles)))
            for triangles in (_padded(solid - low, len(solids)) for solid in solids)
        ]
    values = jnp.asarray(functools.reduce(np.minimum, distances).reshape(shape), float)
    origin = jnp.asarray(low, float)
    remainder = jnp.asarray(low - np.asarray(origin, np.float64), float)
    return MeshGrid(values, origin, remainder, jnp.asarray(spacing, float))


def _padded(triangles: Float[np.ndarray, "F 3 3"], parts: int) -> Float[np.ndarray, "G 3 3"]:
    """Of several parts: as many as fit the same compiled function, filled up with a corner of the first."""
    missing = 2 ** math.ceil(math.log2(len(triangles))) - len(triangles) if parts > 1 else 0
    return np.concatenate([triangles, np.broadcast_to(triangles[0, 0], (missing, 3, 3))])


def mesh_signed_distance(grid: MeshGrid, points: Float[Array, "*p 3"]) -> Float[Array, "*p"]:
    """Signed distance to a mesh, interpolated from its grid, metres, negative inside; differentiable.

    Within the grid the interpolation is trilinear. Its error is at most half a cell's diagonal, 0.87 spacing,
    since the distance is 1-Lipschitz. Where the distance is smooth the error is at most spacing^2 / (4 r), r
    being the distance to the edge, corner or centre of curvature that bends it: none beside plane faces. The
    gradient is that of the interpolant: about unit length, with small steps from cell to cell.

    Outside, with a the distance to the grid's border and b the border's value, the result is sqrt(a^2 + b^2),
    a lower bound of the true distance (up to the above error), which is at most a + b: safe, but choose the
    padding so that it covers what must be accurate.

    Points far from the origin, such as map coordinates, have lost their digits when they become float32.
    Where that may be more than a cell, and more than a hundredth of the distance, the result is NaN: move the
    mesh to the origin (``mesh.apply_translation``), and count points from where it was before they are
    rounded.

    Args:
        grid: from `fill_mesh_grid`.
        points: in the mesh's frame (`doojax.geometry.to_body`), metres.
    """
    points, origin, remainder, last = same_rank(
        points, grid.origin, grid.remainder, jnp.array(grid.values.shape) - 1
    )
    offset = (points - origin) - remainder
    held = jnp.clip(offset, 0, last * grid.spacing)
    cell = jnp.clip(jnp.floor(held / grid.spacing).astype(int), 0, last - 1)
    upper = jnp.moveaxis(held / grid.spacing - cell, -1, 0)
    weights = 1 - upper, upper
    x, y, z = jnp.moveaxis(cell, -1, 0)

    value = jnp.zeros(points.shape[:-1], grid.values.dtype)
    for i, j, k in np.ndindex(2, 2, 2):
        weight = weights[i][0] * weights[j][1] * weights[k][2]
        value += weight * grid.values[x + i, y + j, z + k]

    gap = safe_norm(*jnp.moveaxis(offset - held, -1, 0))
    distance = jnp.where(gap > 0, safe_norm(gap, value), value)
    lost = jnp.finfo(points.dtype).eps * jnp.max(jnp.abs(points), axis=-1)
    return jnp.where(lost > jnp.maximum(grid.spacing, jnp.abs(distance) / 100), jnp.nan, distance)


@jax.jit
def _distances_to_part(points: Float[Array, "P 3"], triangles: Float[Array, "F 3 3"]) -> Float[Array, "P"]:
    def one(point: Float[Array, "3"]) -> Float[Array, ""]:
        squares, angles = jax.vmap(_triangle, (None, 0))(point, triangles)
        winding = jnp.sum(angles) / (4 * jnp.pi)
        return jnp.where(jnp.abs(winding) > 0.5, -1, 1) * jnp.sqrt(jnp.min(squares))

    return jax.lax.map(one, points, batch_size=_NODES_AT_ONCE)


def _triangle(
    point: Float[Array, "3"], triangle: Float[Array, "3 3"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Squared distance from a point to a triangle, and the signed solid angle that the triangle fills there.

    A triangle too thin to have a normal is as near as its edges, and fills no angle.
    """
    # Vectors are tuples of numbers: axes of length three would spoil vectorisation over triangles.
    corners = [tuple(triangle[corner, axis] - point[axis] for axis in range(3)) for corner in range(3)]
    edges = [tuple(e - s for s, e in zip(corners[i], corners[i - 2], strict=True)) for i in range(3)]
    normal = _cross(edges[0], edges[1])
    lengths = [_dot(edge, edge) for edge in edges]
    area, longest = _dot(normal, normal), functools.reduce(jnp.maximum, lengths)
    thin = area <= (_THINNEST * longest) ** 2

    fractions = [
        jnp.clip(-_dot(corner, edge) / jnp.where(length > 0, length, 1), 0, 1)
        for corner, edge, length in zip(corners, edges, lengths, strict=True)
    ]
    on_edges = [
        tuple(start + fraction * step for start, step in zip(corner, edge, strict=True))
        for corner, edge, fraction in zip(corners, edges, fractions, strict=True)
    ]
    to_edges = functools.reduce(jnp.minimum, (_dot(v, v) for v in on_edges))
    inner = [_dot(_cross(edge, normal), corner) >= 0 for edge, corner in zip(edges, corners, strict=True)]
    to_plane = _dot(corners[0], normal) ** 2 / jnp.where(thin, 1, area)
    square = jnp.where(inner[0] & inner[1] & inner[2] & ~thin, to_plane, to_edges)

    # Van Oosterom and Strackee (1983), "The solid angle of a plane triangle".
    a, b, c = (jnp.sqrt(_dot(corner, corner)) for corner in corners)
    ab, bc, ca = (_dot(corners[i], corners[i - 2]) for i in range(3))
    volume = _dot(corners[0], _cross(corners[1], corners[2]))
    angle = 2 * jnp.arctan2(volume, a * b * c + ab * c + bc * a + ca * b)
    return square, jnp.where(thin, 0, angle)


def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def _cross(u, v):
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
