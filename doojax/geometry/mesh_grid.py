"""Signed distance to a mesh: sampled once on a grid, then interpolated and differentiated like any array."""

import functools
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from doojax.geometry.frames import safe_norm

if TYPE_CHECKING:
    from trimesh import Trimesh
else:
    Trimesh = Any  # trimesh is not loaded before a mesh exists

_MOST_NODES = 20_000_000
_NODES_AT_ONCE = 1024


class MeshGrid(eqx.Module):
    """Signed distances at the nodes of a cubic grid around a mesh, in the mesh's own frame, metres."""

    values: Float[Array, "X Y Z"]
    origin: Float[Array, "3"]  # position of node (0, 0, 0)
    spacing: Float[Array, ""]


def fill_mesh_grid(mesh: Trimesh, spacing: float, padding: float) -> MeshGrid:
    """Sample the exact signed distance of a closed mesh on a grid.

    Each node is compared with each triangle: the least point-triangle distance, and for the sign the winding
    number, from the triangles' solid angles. The cost is nodes times faces, about 1e8 pairs per second on two
    CPU cores.

    Args:
        mesh: a watertight `trimesh.Trimesh`, in metres, its normals all outward or all inward.
        spacing: distance between nodes, metres.
        padding: least distance from the mesh's bounding box to the border of the grid, metres, not negative.

    Raises:
        ValueError: if the mesh is not watertight or its faces are wound inconsistently, if spacing or padding
            is out of range, or if the grid would hold more than 20 million nodes.
    """
    if not spacing > 0 or not padding >= 0:
        raise ValueError(
            f"spacing {spacing} and padding {padding} (metres): expected a positive and a non-negative number"
        )
    if not mesh.is_watertight:
        edges = np.sort(mesh.edges, axis=1)
        _, uses = np.unique(edges, axis=0, return_counts=True)
        raise ValueError(
            f"the mesh is not watertight: {np.count_nonzero(uses != 2)} of its {len(uses)} edges do not join "
            "two faces, so it has no inside; close it (for small holes, trimesh.repair.fill_holes)"
        )
    if not mesh.is_winding_consistent:
        raise ValueError(
            "the mesh's faces are wound inconsistently, some outward and some inward: mend them with "
            "trimesh.repair.fix_winding"
        )
    low, high = mesh.bounds[0] - padding, mesh.bounds[1] + padding
    shape = np.ceil((high - low) / spacing - 1e-6).astype(int) + 1  # 1e-6: do not add a node for rounding
    if np.prod(shape.astype(float)) > _MOST_NODES:
        raise ValueError(
            f"a grid of {' x '.join(map(str, shape))} nodes is beyond {_MOST_NODES}: increase spacing "
            f"({spacing} m), or check that the mesh, {np.ptp(mesh.bounds, axis=0)} across, is in metres"
        )
    axes = [low[axis] + spacing * np.arange(shape[axis]) for axis in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = _distances_to_mesh(
        jnp.asarray(nodes, float), jnp.asarray(mesh.triangles[mesh.nondegenerate_faces()], float)
    )
    return MeshGrid(values.reshape(shape), jnp.asarray(low, float), jnp.asarray(spacing, float))


def mesh_signed_distance(grid: MeshGrid, points: Float[Array, "*p 3"]) -> Float[Array, "*p"]:
    """Signed distance to a mesh, interpolated from its grid, metres, negative inside; differentiable.

    Within the grid the interpolation is trilinear. Its error is at most half a cell's diagonal, 0.87 spacing,
    since the distance is 1-Lipschitz. Where the distance is smooth the error is at most spacing^2 / (4 r), r
    being the distance to the edge, corner or centre of curvature that bends it: none beside plane faces. The
    gradient is that of the interpolant: about unit length, with small steps from cell to cell.

    Outside, with a the distance to the grid's border and b the border's value, the result is sqrt(a^2 + b^2),
    a lower bound of the true distance (up to the above error), which is at most a + b: safe, but choose the
    padding so that it covers what must be accurate.

    Args:
        grid: from `fill_mesh_grid`.
        points: in the mesh's frame (`doojax.geometry.to_body`), metres.
    """
    last = jnp.array(grid.values.shape) - 1
    offset = points - grid.origin
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
    return jnp.where(gap > 0, safe_norm(gap, value), value)


@jax.jit
def _distances_to_mesh(points: Float[Array, "P 3"], triangles: Float[Array, "F 3 3"]) -> Float[Array, "P"]:
    def one(point: Float[Array, "3"]) -> Float[Array, ""]:
        distances, angles = jax.vmap(_triangle, (None, 0))(point, triangles)
        winding = jnp.sum(angles) / (4 * jnp.pi)
        return jnp.where(jnp.abs(winding) > 0.5, -1, 1) * jnp.min(distances)

    return jax.lax.map(one, points, batch_size=_NODES_AT_ONCE)


def _triangle(
    point: Float[Array, "3"], triangle: Float[Array, "3 3"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Distance from a point to a triangle, and the signed solid angle that the triangle fills there."""
    # Vectors are tuples of numbers: axes of length three would spoil vectorisation over triangles.
    corners = [tuple(triangle[corner, axis] - point[axis] for axis in range(3)) for corner in range(3)]
    edges = [tuple(e - s for s, e in zip(corners[i], corners[i - 2], strict=True)) for i in range(3)]
    normal = _cross(edges[0], edges[1])

    fractions = [jnp.clip(-_dot(c, e) / _dot(e, e), 0, 1) for c, e in zip(corners, edges, strict=True)]
    on_edges = [
        tuple(start + fraction * step for start, step in zip(corner, edge, strict=True))
        for corner, edge, fraction in zip(corners, edges, fractions, strict=True)
    ]
    to_edges = jnp.sqrt(functools.reduce(jnp.minimum, (_dot(v, v) for v in on_edges)))
    inner = [_dot(_cross(edge, normal), corner) >= 0 for edge, corner in zip(edges, corners, strict=True)]
    to_plane = jnp.abs(_dot(corners[0], normal)) / jnp.sqrt(_dot(normal, normal))
    distance = jnp.where(inner[0] & inner[1] & inner[2], to_plane, to_edges)

    # Van Oosterom and Strackee (1983), "The solid angle of a plane triangle".
    a, b, c = (jnp.sqrt(_dot(corner, corner)) for corner in corners)
    ab, bc, ca = (_dot(corners[i], corners[i - 2]) for i in range(3))
    volume = _dot(corners[0], _cross(corners[1], corners[2]))
    angle = 2 * jnp.arctan2(volume, a * b * c + ab * c + bc * a + ca * b)
    return distance, angle


def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def _cross(u, v):
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
