"""The signed distance to one box, capsule or cylinder, and its derivatives: exact, and written out.

All three shapes are one formula. Fold the point into the body's positive octant and subtract the extents of
a core: the box; the capsule's segment; the cylinder as a box in radius and height. The distance follows from
the excess e: |max(e, 0)| outside, the largest e inside, less the radius by which a capsule inflates its core.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from doojax.geometry.frames import quaternion_to_matrix, safe_norm, same_rank
from doojax.types import Obstacles, ShapeKind

FAR = 1000.0
"""Distance reported to an inactive obstacle, metres: finite, so that losses and gradients stay finite."""

_TINY = 1e-18  # m: what is shorter counts as so long where it divides


def require_one_set(obstacles: Obstacles) -> None:
    """Raise ValueError if obstacles carry batch axes."""
    if obstacles.kind.ndim != 1:
        raise ValueError(
            f"obstacles have batch axes {obstacles.kind.shape[:-1]}, expected one set whose fields start "
            "with the obstacle axis M: use jax.vmap over obstacles and points"
        )


class Numbers(NamedTuple):
    """What distances need to know of obstacles, each number in an array of its own: long axes are fast."""

    centre: list[Array]  # x, y, z
    half_size: list[Array]
    rotation: list[list[Array]]  # rows are the world's axes, columns the body's
    capsule: Array
    cylinder: Array
    active: Array

    def at(self, index: Int[Array, "*i"]) -> "Numbers":
        """Those of the obstacles with these numbers."""
        return jax.tree.map(lambda numbers: numbers[index], self)


def numbers_of(obstacles: Obstacles) -> Numbers:
    """Of one set [M], or of what broadcasts like one."""
    rotation = quaternion_to_matrix(obstacles.quaternion)
    return Numbers(
        [obstacles.centre[..., axis] for axis in range(3)],
        [obstacles.half_size[..., axis] for axis in range(3)],
        [[rotation[..., world, body] for body in range(3)] for world in range(3)],
        obstacles.kind == ShapeKind.CAPSULE,
        obstacles.kind == ShapeKind.CYLINDER,
        obstacles.active,
    )


def paired_distances(obstacles: Obstacles, points: Float[Array, "*#p 3"]) -> Float[Array, "*p"]:
    """Distance from each point to the obstacle that broadcasting pairs it with."""
    return distance_and_gradient(numbers_of(obstacles), *(points[..., axis] for axis in range(3)))[0]


def _of_one_rank(point: tuple[Array, ...], to: Numbers) -> tuple[tuple[Array, ...], Numbers]:
    leaves, structure = jax.tree.flatten((point, to))
    return jax.tree.unflatten(structure, same_rank(*leaves))


def distance_and_gradient(
    to: Numbers, *point: Float[Array, "*#p"]
) -> tuple[Float[Array, "*p"], Float[Array, "*p"], Float[Array, "*p"], Float[Array, "*p"]]:
    """Distance from x, y, z to the obstacle that broadcasting pairs them with, and its three derivatives."""
    point, to = _of_one_rank(point, to)
    offset = [coordinate - centre for coordinate, centre in zip(point, to.centre, strict=True)]
    along = [sum(to.rotation[world][body] * offset[world] for world in range(3)) for body in range(3)]
    x, y, z = (jnp.abs(coordinate) for coordinate in along)
    half_x, half_y, half_z = to.half_size
    capsule, cylinder = to.capsule, to.cylinder

    from_axis = safe_norm(x, y)
    excess_x = jnp.where(cylinder, from_axis, x) - jnp.where(capsule, 0, half_x)
    # A cylinder's second direction must never count: keep it below its first, which is at least -half_x.
    excess_y = jnp.where(cylinder, -2 * half_x, y - jnp.where(capsule, 0, half_y))
    excess_z = z - half_z
    largest = jnp.maximum(jnp.maximum(excess_x, excess_y), excess_z)
    beyond = [jnp.maximum(excess, 0) for excess in (excess_x, excess_y, excess_z)]
    outside, length = largest > 0, safe_norm(*beyond)
    distance = jnp.where(outside, length, largest) - jnp.where(capsule, half_x, 0)

    first, second = excess_x == largest, excess_y == largest
    deepest = (first, second & ~first, ~(first | second))
    one = jnp.where(jnp.isnan(largest), largest, 1.0)
    by_x, by_y, by_z = (
        jnp.where(outside, part / jnp.maximum(length, _TINY), jnp.where(this, one, 0.0))
        for part, this in zip(beyond, deepest, strict=True)
    )
    radial = by_x / jnp.maximum(from_axis, _TINY)  # a cylinder's first direction is any away from its axis
    in_body = [
        jnp.where(cylinder, radial * along[0], jnp.sign(along[0]) * by_x),
        jnp.where(cylinder, radial * along[1], jnp.sign(along[1]) * by_y),
        jnp.sign(along[2]) * by_z,
    ]
    slope_x, slope_y, slope_z = (
        jnp.where(to.active, sum(to.rotation[world][body] * in_body[body] for body in range(3)), 0)
        for world in range(3)
    )
    return jnp.where(to.active, distance, FAR), slope_x, slope_y, slope_z
