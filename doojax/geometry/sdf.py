"""Signed distance to a set of boxes, capsules and cylinders: exact, negative inside, differentiable.

All three shapes are one formula. Fold the point into the body's positive octant and subtract the extents of
a core: the box; the capsule's segment; the cylinder as a box in radius and height. The distance follows from
the excess e: |max(e, 0)| outside, the largest e inside, less the radius by which a capsule inflates its core.

The gradient has length one, except on the kinks inside an obstacle (points equally deep below several faces,
axes), where it is some vector of length at most one. It is NaN only where a coordinate is, of the point or
of the nearest obstacle.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import Bool, Float, Int, Shaped

from doojax.geometry.frames import quaternion_to_matrix, safe_norm, same_rank
from doojax.types import Obstacles, ShapeKind

FAR = 1000.0
"""Distance reported to an inactive obstacle, metres: finite, so that losses and gradients stay finite."""

_TINY = 1e-18  # m: what is shorter counts as so long where it divides
_VECTOR = 8  # numbers (float32, AVX2) that a CPU computes at once
_SHRINK = 0.55  # of the bracket kept by each step of the search along a segment
_HALVINGS = 7  # of a segment that is only asked whether it is far
_SEARCH_STEPS = 23  # which leave _SHRINK**23 = 1.1e-6 of the segment


def signed_distance(obstacles: Obstacles, points: Float[Array, "*p 3"]) -> Float[Array, "*p"]:
    """Distance from each point to the nearest active obstacle, metres, negative inside.

    Where obstacles overlap it is the depth in the one entered deepest: the sign is that of their union, the
    depth at most that in their union.

    Args:
        obstacles: one unbatched set; `jax.vmap` for a batch of sets.
        points: world frame, metres.

    Returns:
        the distance; `FAR`, with zero gradient, where no obstacle is active.

    Raises:
        ValueError: if the obstacles carry batch axes.
    """
    _require_one_set(obstacles)
    if obstacles.kind.shape == (0,):
        return jnp.full(points.shape[:-1], FAR, points.dtype)
    return _least_distance(obstacles, points)


def signed_distances(obstacles: Obstacles, points: Float[Array, "*p 3"]) -> Float[Array, "*p M"]:
    """Distance from each point to each obstacle, metres, negative inside; `FAR` for inactive obstacles.

    Arguments and errors as for `signed_distance`.
    """
    _require_one_set(obstacles)
    return _distances(obstacles, points[..., None, :])


def nearest_obstacle(obstacles: Obstacles, points: Float[Array, "*p 3"]) -> Int[Array, "*p"]:
    """Index of the active obstacle with the least signed distance to each point; -1 where none is active.

    Arguments and errors as for `signed_distance`.
    """
    _require_one_set(obstacles)
    if obstacles.kind.shape == (0,):
        return jnp.full(points.shape[:-1], -1)
    return jnp.where(jnp.any(obstacles.active), _nearest(obstacles, points)[1], -1)


def segment_signed_distance(
    obstacles: Obstacles, start: Float[Array, "*p 3"], end: Float[Array, "*p 3"]
) -> Float[Array, "*p"]:
    """Least signed distance along each straight segment, metres: how near, or how deep inside, it comes.

    A rope link of radius r from ``start`` to ``end`` clears the obstacles by this value less r. Where that is
    negative, the link's deepest ball of radius r would have to move that far to leave its obstacle.

    The signed distance of a convex body is convex along a line, so a search by shrinking brackets, one per
    obstacle, finds the least value: exactly where it lies at an end, else to within 1.1e-6 of the segment's
    length (or the rounding of the coordinates). The gradient is that of `signed_distance` at the point found,
    held at its fraction of the segment: the true one (envelope theorem), unless that point lies on a kink
    inside an obstacle, equally deep below two faces, where it is the gradient towards one of them.

    Arguments and errors as for `signed_distance`.
    """
    _require_one_set(obstacles)
    if obstacles.kind.shape == (0,):
        return jnp.full(start.shape[:-1], FAR, start.dtype)
    fraction = _closest_fraction(*stop_gradient((obstacles, start, end)))
    return _least_distance(obstacles, start + fraction[..., None] * (end - start))


def segment_is_far(
    obstacles: Obstacles, start: Float[Array, "*p 3"], end: Float[Array, "*p 3"], distance: Float[Array, "*p"]
) -> Bool[Array, "*p"]:
    """Whether a segment is farther than ``distance`` (m) from all obstacles: True only where that is certain.

    In a third of the time of `segment_signed_distance`, for planners that ask often. The distance is convex
    along the segment, so its slope says on which side of a point it is least; what is left of the segment
    after seven halvings is 1/128 of it, and False may be said where half of that is missing.

    Arguments and errors as for `segment_signed_distance`.
    """
    _require_one_set(obstacles)
    numbers = _numbers(obstacles)
    begin = [start[..., axis, None] for axis in range(3)]
    step = [(end - start)[..., axis, None] for axis in range(3)]

    def at(fraction: Array) -> tuple[Array, Array]:
        point = (one + fraction * along for one, along in zip(begin, step, strict=True))
        value, *slopes = _distance_and_gradient(numbers, *point)
        along = (slope * one for slope, one in zip(slopes, step, strict=True))
        return value, sum(along, jnp.zeros_like(value))

    def halve(number: Array, middle: Array) -> Array:
        _, slope = at(middle)
        return middle - jnp.sign(slope) * 0.5 ** (number + 2)

    zero = jnp.zeros((*start.shape[:-1], obstacles.kind.shape[0]), start.dtype)
    middle = jax.lax.fori_loop(0, _HALVINGS, halve, zero + 0.5)
    nearest = at(middle)[0] - 0.5 ** (_HALVINGS + 1) * safe_norm(*step)
    return jnp.all(nearest > distance[..., None], axis=-1)


def _closest_fraction(
    obstacles: Obstacles, start: Float[Array, "*p 3"], end: Float[Array, "*p 3"]
) -> Float[Array, "*p"]:
    """Where on each segment the signed distance is least, as a fraction of the segment."""
    start, step = start[..., None, :], (end - start)[..., None, :]

    def distances_at(fraction: Float[Array, "*p M"]) -> Float[Array, "*p M"]:
        return _distances(obstacles, start + fraction[..., None] * step)

    def shrink(step_index, low):
        width = _SHRINK**step_index
        left, right = low + (1 - _SHRINK) * width, low + _SHRINK * width
        return jnp.where(distances_at(right) < distances_at(left), left, low)

    zero = jnp.zeros((*start.shape[:-2], obstacles.kind.shape[0]), start.dtype)
    low = jax.lax.fori_loop(0, _SEARCH_STEPS, shrink, zero)
    middle = low + _SHRINK**_SEARCH_STEPS / 2

    fractions = jnp.concatenate([zero, middle, zero + 1], axis=-1)
    distances = jnp.concatenate([distances_at(part) for part in jnp.split(fractions, 3, axis=-1)], axis=-1)
    return jnp.take_along_axis(fractions, jnp.argmin(distances, axis=-1, keepdims=True), axis=-1)[..., 0]


def _require_one_set(obstacles: Obstacles) -> None:
    if obstacles.kind.ndim != 1:
        raise ValueError(
            f"obstacles have batch axes {obstacles.kind.shape[:-1]}, expected one set whose fields start "
            "with the obstacle axis M: use jax.vmap over obstacles and points"
        )


def signed_distance_and_gradient(
    obstacles: Obstacles, x: Float[Array, "*p"], y: Float[Array, "*p"], z: Float[Array, "*p"]
) -> tuple[Float[Array, "*p"], Float[Array, "*p"], Float[Array, "*p"], Float[Array, "*p"]]:
    """`signed_distance` and its derivatives by x, y and z, written out: less time than `jax.grad` on a CPU.

    On kinks, where the derivative is any of several, it may be another than that of `jax.grad`.

    Args:
        obstacles: one unbatched set; `jax.vmap` for a batch of sets.
        x, y, z: world frame, metres; apart, because a CPU is fast with long axes.

    Returns:
        the distance in metres, `FAR` where no obstacle is active, and the gradient's components along the
        world's axes: of length one away from kinks, zero where no obstacle is active.

    Raises:
        ValueError: if the obstacles carry batch axes, or x, y and z differ in shape.
    """
    _require_one_set(obstacles)
    if not jnp.shape(x) == jnp.shape(y) == jnp.shape(z):
        raise ValueError(
            f"x, y and z have shapes {jnp.shape(x)}, {jnp.shape(y)} and {jnp.shape(z)}, expected one shape: "
            "use jnp.broadcast_arrays"
        )
    if obstacles.kind.shape == (0,):
        far = jnp.full(jnp.shape(x), FAR, jnp.result_type(x, obstacles.centre))
        return far, jnp.zeros_like(far), jnp.zeros_like(far), jnp.zeros_like(far)
    return _nearest_with_gradient(obstacles, x, y, z)


def signed_distances_and_gradients(
    obstacles: Obstacles, x: Float[Array, "*p"], y: Float[Array, "*p"], z: Float[Array, "*p"]
) -> tuple[Float[Array, "M *p"], Float[Array, "M *p"], Float[Array, "M *p"], Float[Array, "M *p"]]:
    """`signed_distances` and their derivatives by x, y and z, obstacles first, written out.

    Arguments and errors as for `signed_distance_and_gradient`.
    """
    _require_one_set(obstacles)
    shape = (-1, *[1] * jnp.ndim(x))
    numbers = jax.tree.map(lambda one: one.reshape(shape), _numbers(obstacles))
    return _distance_and_gradient(numbers, x[None], y[None], z[None])


@jax.jit
def _nearest_with_gradient(obstacles: Obstacles, *point: Float[Array, "*p"]) -> tuple[Array, ...]:
    def at_once(obstacles: Obstacles, *point: Array) -> tuple[Array, ...]:
        nearest = _nearest(obstacles, jnp.stack(point, axis=-1))[1]
        return _distance_and_gradient(_numbers(obstacles).at(nearest), *point)

    def in_turn(obstacles: Obstacles, *point: Array) -> tuple[Array, ...]:
        flat = [_padded(coordinate) for coordinate in point]
        distance, nearest = _nearest_in_turn(obstacles, *flat)
        # Were they gathered within the loops that use them, these would be scalar code.
        theirs = jax.lax.optimization_barrier(_numbers(obstacles).at(nearest))
        gradient = _distance_and_gradient(theirs, *flat)[1:]
        return tuple(_unpadded(one, point[0].shape) for one in (distance, *gradient))

    return jax.lax.platform_dependent(obstacles, *point, cpu=in_turn, default=at_once)


@jax.custom_jvp
def _least_distance(obstacles: Obstacles, points: Float[Array, "*p 3"]) -> Float[Array, "*p"]:
    return _nearest(obstacles, points)[0]


@_least_distance.defjvp
def _least_distance_jvp(primals, tangents):
    # Only the nearest obstacle moves the minimum: differentiating it alone is several times faster than
    # differentiating all of them, and leaves no average of gradients where two are equally near.
    nearest = _nearest(*primals)[1]

    def distance(obstacles: Obstacles, points: Array) -> Array:
        return _distances(jax.tree.map(lambda field: field[nearest], obstacles), points)

    return jax.jvp(distance, primals, tangents)


@jax.jit
def _nearest(
    obstacles: Obstacles, points: Float[Array, "*p 3"]
) -> tuple[Float[Array, "*p"], Int[Array, "*p"]]:
    """The least distance to any obstacle, and the index of the first that is so near, or the first NaN."""

    def at_once(obstacles: Obstacles, points: Array) -> tuple[Array, Array]:
        distances = _distances(obstacles, points[..., None, :])
        return jnp.min(distances, axis=-1), jnp.argmin(distances, axis=-1)

    def in_turn(obstacles: Obstacles, points: Array) -> tuple[Array, Array]:
        shape = points.shape[:-1]
        found = _nearest_in_turn(obstacles, *(_padded(points[..., axis]) for axis in range(3)))
        return _unpadded(found[0], shape), _unpadded(found[1], shape)

    return jax.lax.platform_dependent(obstacles, points, cpu=in_turn, default=at_once)


def _nearest_in_turn(obstacles: Obstacles, *point: Float[Array, "p"]) -> tuple[Array, Array]:
    # XLA's reduction to a value and its index is scalar code on a CPU: this is several times faster.
    numbers = _numbers(obstacles)

    def distance_to(index):
        return _distance_and_gradient(numbers.at(index), *point)[0]

    def closer(index, best):
        distance = distance_to(index)
        nearer = (distance < best[0]) | (jnp.isnan(distance) & ~jnp.isnan(best[0]))
        return jnp.where(nearer, distance, best[0]), jnp.where(nearer, index, best[1])

    farthest = jnp.full_like(distance_to(jnp.array(0)), jnp.inf)
    return jax.lax.fori_loop(0, obstacles.kind.shape[0], closer, (farthest, jnp.zeros_like(farthest, int)))


def _padded(values: Float[Array, "*p"]) -> Float[Array, "q"]:
    # What does not fill a CPU's vectors is computed one by one, which can cost as much as all the rest.
    return jnp.pad(values.reshape(-1), (0, -values.size % _VECTOR), mode="edge")


def _unpadded(values: Shaped[Array, "q"], shape: tuple[int, ...]) -> Shaped[Array, "*p"]:
    return values[: math.prod(shape)].reshape(shape)


class _Numbers(NamedTuple):
    """What distances need to know of obstacles, each number in an array of its own: long axes are fast."""

    centre: list[Array]  # x, y, z
    half_size: list[Array]
    rotation: list[list[Array]]  # rows are the world's axes, columns the body's
    capsule: Array
    cylinder: Array
    active: Array

    def at(self, index: Int[Array, "*i"]) -> "_Numbers":
        return jax.tree.map(lambda numbers: numbers[index], self)


def _numbers(obstacles: Obstacles) -> _Numbers:
    rotation = quaternion_to_matrix(obstacles.quaternion)
    return _Numbers(
        [obstacles.centre[..., axis] for axis in range(3)],
        [obstacles.half_size[..., axis] for axis in range(3)],
        [[rotation[..., world, body] for body in range(3)] for world in range(3)],
        obstacles.kind == ShapeKind.CAPSULE,
        obstacles.kind == ShapeKind.CYLINDER,
        obstacles.active,
    )


def _distances(obstacles: Obstacles, points: Float[Array, "*#p 3"]) -> Float[Array, "*p"]:
    """Distance from each point to the obstacle that broadcasting pairs it with."""
    return _distance_and_gradient(_numbers(obstacles), *(points[..., axis] for axis in range(3)))[0]


def _of_one_rank(point: tuple[Array, ...], to: _Numbers) -> tuple[tuple[Array, ...], _Numbers]:
    leaves, structure = jax.tree.flatten((point, to))
    return jax.tree.unflatten(structure, same_rank(*leaves))


def _distance_and_gradient(
    to: _Numbers, *point: Float[Array, "*#p"]
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
