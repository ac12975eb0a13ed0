"""Signed distance to a set of boxes, capsules and cylinders: exact, negative inside, differentiable.

The gradient has length one, except on the kinks inside an obstacle (points equally deep below several faces,
axes), where it is some vector of length at most one. It is NaN only where a coordinate is, of the point or
of the nearest obstacle.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float, Int, Shaped

from doojax.geometry.shapes import (
    FAR,
    distance_and_gradient,
    numbers_of,
    paired_distances,
    require_one_set,
)
from doojax.types import Obstacles

_VECTOR = 8  # numbers (float32, AVX2) that a CPU computes at once


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
    require_one_set(obstacles)
    if obstacles.kind.shape == (0,):
        return jnp.full(points.shape[:-1], FAR, points.dtype)
    return least_distance(obstacles, *(points[..., axis] for axis in range(3)))


def signed_distance_at(
    obstacles: Obstacles, x: Float[Array, "*p"], y: Float[Array, "*p"], z: Float[Array, "*p"]
) -> Float[Array, "*p"]:
    """`signed_distance` of points whose coordinates (m) are apart: on a CPU its gradient takes half the time.

    Raises:
        ValueError: if the obstacles carry batch axes.
    """
    require_one_set(obstacles)
    if obstacles.kind.shape == (0,):
        return jnp.full(jnp.shape(x), FAR, jnp.result_type(x))
    return least_distance(obstacles, x, y, z)


def signed_distances(obstacles: Obstacles, points: Float[Array, "*p 3"]) -> Float[Array, "*p M"]:
    """Distance from each point to each obstacle, metres, negative inside; `FAR` for inactive obstacles.

    Arguments and errors as for `signed_distance`.
    """
    require_one_set(obstacles)
    return paired_distances(obstacles, points[..., None, :])


def nearest_obstacle(obstacles: Obstacles, points: Float[Array, "*p 3"]) -> Int[Array, "*p"]:
    """Index of the active obstacle with the least signed distance to each point; -1 where none is active.

    Arguments and errors as for `signed_distance`.
    """
    require_one_set(obstacles)
    if obstacles.kind.shape == (0,):
        return jnp.full(points.shape[:-1], -1)
    return jnp.where(jnp.any(obstacles.active), _nearest(obstacles, points)[1], -1)


def signed_distance_and_gradient(
    obstacles: Obstacles, x: Float[Array, "*p"], y: Float[Array, "*p"], z: Float[Array, "*p"]
) -> tuple[Float[Array, "*p"], Float[Array, "*p"], Float[Array, "*p"], Float[Array, "*p"]]:
    """`signed_distance` and its derivatives by x, y and z, written out: less time than `jax.grad` on a CPU.

    On kinks, where the derivative is any of several, it may be another than that of `jax.grad`.

    Args:
        obstacles: one unbatched set; `jax.vmap` for a batch of sets.
        x: world frame, metres; each coordinate apart, because a CPU is fast with long axes.
        y: as ``x``.
        z: as ``x``.

    Returns:
        the distance in metres, `FAR` where no obstacle is active, and the gradient's components along the
        world's axes: of length one away from kinks, zero where no obstacle is active.

    Raises:
        ValueError: if the obstacles carry batch axes, or x, y and z differ in shape.
    """
    require_one_set(obstacles)
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
    require_one_set(obstacles)
    shape = (-1, *[1] * jnp.ndim(x))
    numbers = jax.tree.map(lambda one: one.reshape(shape), numbers_of(obstacles))
    return distance_and_gradient(numbers, x[None], y[None], z[None])


@jax.jit
def _nearest_with_gradient(obstacles: Obstacles, *point: Float[Array, "*p"]) -> tuple[Array, ...]:
    def at_once(obstacles: Obstacles, *point: Array) -> tuple[Array, ...]:
        nearest = _nearest(obstacles, jnp.stack(point, axis=-1))[1]
        return distance_and_gradient(numbers_of(obstacles).at(nearest), *point)

    def in_turn(obstacles: Obstacles, *point: Array) -> tuple[Array, ...]:
        # The gradient to every obstacle costs less than to gather the numbers of those that are nearest.
        numbers, flat = numbers_of(obstacles), [_padded(coordinate) for coordinate in point]

        def closer(index: Array, best: tuple[Array, ...]) -> tuple[Array, ...]:
            found = distance_and_gradient(numbers.at(index), *flat)
            nearer = _nearer(found[0], best[0])
            return tuple(jnp.where(nearer, new, old) for new, old in zip(found, best, strict=True))

        first = distance_and_gradient(numbers.at(jnp.array(0)), *flat)
        best = jax.lax.fori_loop(1, obstacles.kind.shape[0], closer, first)
        return tuple(_unpadded(one, point[0].shape) for one in best)

    return jax.lax.platform_dependent(obstacles, *point, cpu=in_turn, default=at_once)


@jax.custom_jvp
def least_distance(
    obstacles: Obstacles, x: Float[Array, "*p"], y: Float[Array, "*p"], z: Float[Array, "*p"]
) -> Float[Array, "*p"]:
    """`signed_distance_at` with at least one obstacle."""
    return _nearest(obstacles, jnp.stack([x, y, z], axis=-1))[0]


@partial(least_distance.defjvp, symbolic_zeros=True)
def _least_distance_jvp(primals, tangents):
    # Only the nearest obstacle moves the minimum: differentiating it alone is several times faster than
    # differentiating all of them, and leaves no average of gradients where two are equally near.
    obstacles, *point = primals
    if all(isinstance(leaf, SymbolicZero) for leaf in jax.tree.leaves(tangents[0])):  # they do not move
        distance, *slopes = _nearest_with_gradient(obstacles, *point)
        moves = zip(slopes, tangents[1:], strict=True)
        parts = [slope * way for slope, way in moves if not isinstance(way, SymbolicZero)]
        return distance, sum(parts, start=jnp.zeros_like(distance))
    nearest = _nearest(obstacles, jnp.stack(point, axis=-1))[1]

    def of_nearest(obstacles: Obstacles, *point: Array) -> Array:
        return paired_distances(
            jax.tree.map(lambda field: field[nearest], obstacles), jnp.stack(point, axis=-1)
        )

    return jax.jvp(of_nearest, primals, jax.tree.map(_instantiated, primals, tangents))


def _instantiated(primal: Array, tangent: Any) -> Any:
    if not isinstance(tangent, SymbolicZero):
        return tangent
    inexact = jnp.issubdtype(primal.dtype, jnp.inexact)
    return jnp.zeros_like(primal) if inexact else np.zeros(primal.shape, jax.dtypes.float0)


@jax.jit
def _nearest(
    obstacles: Obstacles, points: Float[Array, "*p 3"]
) -> tuple[Float[Array, "*p"], Int[Array, "*p"]]:
    """The least distance to any obstacle, and the index of the first that is so near, or the first NaN."""

    def at_once(obstacles: Obstacles, points: Array) -> tuple[Array, Array]:
        distances = paired_distances(obstacles, points[..., None, :])
        return jnp.min(distances, axis=-1), jnp.argmin(distances, axis=-1)

    def in_turn(obstacles: Obstacles, points: Array) -> tuple[Array, Array]:
        shape = points.shape[:-1]
        found = _nearest_in_turn(obstacles, *(_padded(points[..., axis]) for axis in range(3)))
        return _unpadded(found[0], shape), _unpadded(found[1], shape)

    return jax.lax.platform_dependent(obstacles, points, cpu=in_turn, default=at_once)


def _nearest_in_turn(obstacles: Obstacles, *point: Float[Array, "p"]) -> tuple[Array, Array]:
    # XLA's reduction to a value and its index is scalar code on a CPU: this is several times faster.
    numbers = numbers_of(obstacles)

    def distance_to(index):
        return distance_and_gradient(numbers.at(index), *point)[0]

    def closer(index, best):
        distance = distance_to(index)
        nearer = _nearer(distance, best[0])
        return jnp.where(nearer, distance, best[0]), jnp.where(nearer, index, best[1])

    farthest = jnp.full_like(distance_to(jnp.array(0)), jnp.inf)
    return jax.lax.fori_loop(0, obstacles.kind.shape[0], closer, (farthest, jnp.zeros_like(farthest, int)))


def _nearer(distance: Array, best: Array) -> Array:
    return (distance < best) | (jnp.isnan(distance) & ~jnp.isnan(best))


def _padded(values: Float[Array, "*p"]) -> Float[Array, "q"]:
    # What does not fill a CPU's vectors is computed one by one, which can cost as much as all the rest.
    return jnp.pad(values.reshape(-1), (0, -values.size % _VECTOR), mode="edge")


def _unpadded(values: Shaped[Array, "q"], shape: tuple[int, ...]) -> Shaped[Array, "*p"]:
    return values[: math.prod(shape)].reshape(shape)
