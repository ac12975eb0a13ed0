"""The magnetic field of a loop that carries a unit current: it shows the way through the loop.

The direction is right-handed: with the thumb of the right hand along the loop's order of points, the fingers
curl along the field. Reversing the loop reverses its field. So does the sign convention: equation 5.1 of the
thesis is right-handed, but its released code swaps the two factors of a cross product (p' x p for p x p') and
yields the opposite field; it lists the points of its skeletons in the order that suits this. Linking numbers
without sign do not depend on it; the direction in which a rope is threaded does.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from doojax.geometry import safe_norm


def magnetic_field(loop: Float[Array, "P 3"], point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Field (1 / 4 pi) oint ds x r / |r|^3 of a polyline at a point, r from ds to the point: Biot and Savart.

    Exact: one closed form per segment, differentiable in both arguments. Integrated along a closed curve it
    gives the curve's linking number with the loop (`doojax.topology.linking_of`, curve first).

    Args:
        loop: a polyline, metres, its last point repeating its first; padding by repeated points adds nothing.
        point: where, metres.

    Returns:
        the field, 1/metres. It grows without bound towards the loop; of a segment that the point lies on,
        only the rest counts.
    """
    to_points = loop - point[None]
    contribution = jax.vmap(_segment)(to_points[:-1], to_points[1:])
    return jnp.sum(contribution, axis=0) / (4 * jnp.pi)


def field_line(
    loop: Float[Array, "P 3"], start: Float[Array, "3"], *, step: float, count: int
) -> Float[Array, "N 3"]:
    """A line to draw: `start` and `count` more points along the field, `step` metres apart.

    A negative step goes against the field.

    Each step is one of Runge and Kutta's, of fourth order, along the unit vector of the field.
    """

    def direction(point: Float[Array, "3"]) -> Float[Array, "3"]:
        field = magnetic_field(loop, point)
        length = safe_norm(*field)
        return field / jnp.where(length > 0, length, 1)

    def advance(point: Float[Array, "3"], _: None):
        first = direction(point)
        second = direction(point + step / 2 * first)
        third = direction(point + step / 2 * second)
        fourth = direction(point + step * third)
        new = point + step / 6 * (first + 2 * second + 2 * third + fourth)
        return new, new

    _, points = jax.lax.scan(advance, start, None, length=count)
    return jnp.concatenate([start[None], points])


def _segment(p: Float[Array, "3"], q: Float[Array, "3"]) -> Float[Array, "3"]:
    """4 pi times the field at the origin of a segment from p to q."""
    normal = jnp.cross(p, q - p)  # not p x q, which cancels for short segments far away
    a, b = safe_norm(*p), safe_norm(*q)
    along = jnp.sum(p * q)
    # p x q (1/a + 1/b) / (ab + p.q), with (ab + p.q)(ab - p.q) = |p x q|^2 where the first factor cancels.
    square = jnp.sum(normal * normal)
    apart = along >= 0
    divisor = jnp.where(apart, a * b * (a * b + along), a * b * square)
    factor = jnp.where(apart, 1, a * b - along)
    beside = square > 0
    return jnp.where(beside, normal * (factor * (a + b) / jnp.where(beside, divisor, 1)), 0)
