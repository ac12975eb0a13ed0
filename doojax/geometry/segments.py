"""Distances between straight segments: those of capsules, but for their radii."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.geometry.frames import safe_norm

_TINY = 1e-12  # m^2: a segment whose square is shorter is a point


def segment_distance(
    start: Float[Array, "*b 3"],
    end: Float[Array, "*b 3"],
    other_start: Float[Array, "*b 3"],
    other_end: Float[Array, "*b 3"],
) -> Float[Array, "*b"]:
    """Least distance between two segments, metres; zero, with zero gradient, where they meet.

    The squared distance is convex in the two fractions of the way, so it is least where the lines are
    nearest, or with one fraction at an end and the other the nearest to it: the least of five candidates.
    """
    step, other_step = end - start, other_end - other_start
    gap = start - other_start
    a, b, c = (step**2).sum(-1), (step * other_step).sum(-1), (other_step**2).sum(-1)
    d, e = (step * gap).sum(-1), (other_step * gap).sum(-1)
    safe_a, safe_c = jnp.maximum(a, _TINY), jnp.maximum(c, _TINY)
    area = a * c - b * b
    crossing = jnp.where(area > 1e-6 * a * c, (b * e - c * d) / jnp.where(area > 0, area, 1), 0)
    zero, one = jnp.zeros_like(a), jnp.ones_like(a)

    def on_other(fraction: Array) -> Array:
        return jnp.clip((e + b * fraction) / safe_c, 0, 1)

    def on_this(fraction: Array) -> Array:
        return jnp.clip((b * fraction - d) / safe_a, 0, 1)

    inner = jnp.clip(crossing, 0, 1)
    tried = [(s, on_other(s)) for s in (inner, zero, one)] + [(on_this(t), t) for t in (zero, one)]
    lengths = [
        safe_norm(*jnp.moveaxis(gap + s[..., None] * step - t[..., None] * other_step, -1, 0))
        for s, t in tried
    ]
    return jnp.min(jnp.stack(lengths), axis=0)
