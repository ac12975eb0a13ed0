"""Does a straight motion enter an obstacle? Exact for boxes, capsules and cylinders, without a search."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from doojax.geometry.frames import rotate_inverse
from doojax.types import Obstacles, ShapeKind


def enters(obstacles: Obstacles, start: Float[Array, "*p 3"], end: Float[Array, "*p 3"]) -> Bool[Array, "*p"]:
    """Does the segment from each ``start`` to its ``end`` meet the inside of an active obstacle?

    Each shape is a union of intersections of slabs, infinite cylinders and balls, and a line is within each
    of those for one interval: what is looked for is a common interval of some length.

    Args:
        obstacles: one unbatched set of M; `jax.vmap` for a batch of sets.
        start: of each segment, world frame, metres.
        end: as ``start``.

    Returns:
        true where it does; NaN coordinates enter nothing.
    """
    if obstacles.kind.shape == (0,):
        return jnp.zeros(start.shape[:-1], dtype=bool)

    def one(obstacle: Obstacles) -> Bool[Array, "*p"]:
        p = rotate_inverse(obstacle.quaternion, start - obstacle.centre)
        step = rotate_inverse(obstacle.quaternion, end - start)
        x, _, z = obstacle.half_size
        slabs = [_slab(p[..., axis], step[..., axis], obstacle.half_size[axis]) for axis in range(3)]
        tube = _common(_ball(p[..., :2], step[..., :2], x), slabs[2])
        caps = [_ball(p - jnp.array([0, 0, sign]) * z, step, x) for sign in (-1, 1)]
        inside = jnp.where(
            obstacle.kind == ShapeKind.BOX,
            _some(_common(*slabs)),
            _some(tube) | ((obstacle.kind == ShapeKind.CAPSULE) & (_some(caps[0]) | _some(caps[1]))),
        )
        return inside & obstacle.active

    return jax.lax.map(one, obstacles).any(0)


type _Interval = tuple[Array, Array]  # of the fraction of the way


def _slab(p: Array, step: Array, half: Array) -> _Interval:
    """While |p + t step| < half."""
    moving = jnp.where(step == 0, 1.0, step)
    ends = (-half - p) / moving, (half - p) / moving
    low, high = jnp.minimum(*ends), jnp.maximum(*ends)
    always = jnp.abs(p) < half
    return (
        jnp.where(step == 0, jnp.where(always, -jnp.inf, jnp.inf), low),
        jnp.where(step == 0, jnp.where(always, jnp.inf, -jnp.inf), high),
    )


def _ball(p: Array, step: Array, radius: Array) -> _Interval:
    """While |p + t step| < radius, in as many dimensions as there are."""
    square, half = (step**2).sum(-1), (p * step).sum(-1)
    moving = jnp.where(square == 0, 1.0, square)
    nearest = p - (half / moving)[..., None] * step  # its distance from the centre, without cancellation
    room = radius**2 - jnp.where(square == 0, (p**2).sum(-1), (nearest**2).sum(-1))
    reach = jnp.sqrt(jnp.maximum(room, 0) / moving)
    low, high = -half / moving - reach, -half / moving + reach
    low, high = jnp.where(square == 0, -jnp.inf, low), jnp.where(square == 0, jnp.inf, high)
    return jnp.where(room > 0, low, jnp.inf), jnp.where(room > 0, high, -jnp.inf)


def _common(*intervals: _Interval) -> _Interval:
    lows, highs = zip(*intervals, strict=True)
    return jnp.max(jnp.stack(lows), 0), jnp.min(jnp.stack(highs), 0)


def _some(interval: _Interval) -> Bool[Array, "*p"]:
    """Does the interval meet the way from 0 to 1?"""
    low, high = interval
    return jnp.maximum(low, 0.0) < jnp.minimum(high, 1.0)
