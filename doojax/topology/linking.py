"""Exact linking numbers of closed polylines.

A loop is an array ``[P, 3]`` whose last point repeats its first. To pad a loop, repeat its last point again:
segments without length change neither linking numbers nor distances.

How the number is found. Both curves are snapped to a cubic grid, 2**23 cells along the longest side of their
bounding box: about the resolution of float32. Seen along z, two segments cross or do not; that is decided by
the signs of 2 x 2 determinants of whole numbers, computed without rounding error (`_is_left`), and a
determinant of zero is decided as if the second curve were moved aside by an infinitely small amount. The
linking number is the sum of the signs of those crossings at which the first curve passes above the second.
No integral is approximated and nothing is rounded to an integer. Which curve is above is compared in float32
at a place known to a few cells, so the number is proven when the curves stay 84 cells apart (`TOUCHING`);
closer ones are reported.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

TOUCHING = 1e-5
"""Curves closer than this fraction of the longest side of their bounding box are reported as touching."""

_CELLS = 2.0**23  # coordinates and their differences are then exact in float32
_SURE = 2.0**28  # a float32 determinant of larger magnitude has the right sign, a smaller one fits int32
_LANES = 16  # XLA's loops on a CPU handle what is left over from a multiple of this one by one


class Linking(eqx.Module):
    """How two loops are linked, and how sure that is."""

    number: Int[Array, "*b"]  # signed linking number; reversing one of the loops flips its sign
    margin: Float[Array, "*b"]  # least distance between the curves, metres, to 3e-7 of their bounding box
    touching: Bool[Array, "*b"]  # the margin is not above `TOUCHING` of the bounding box: the number is void


class Grid(eqx.Module):
    """The grid that curves are snapped to before they are compared."""

    corner: Float[Array, "3"]
    size: Float[Array, ""]  # longest side of the bounding box, metres

    @staticmethod
    def over(points: Float[Array, "3 P"]) -> "Grid":
        """The grid over the bounding box of points. One row per axis, here and below, vectorises best."""
        low = jnp.min(points, axis=1)
        return Grid(low, jnp.max(jnp.max(points, axis=1) - low))

    def snap(self, points: Float[Array, "3 P"]) -> Float[Array, "3 P"]:
        """Coordinates in cells: whole numbers, as float32."""
        return jnp.round((points - self.corner[:, None]) * (_CELLS / self.size)).astype(jnp.float32)

    def margin(
        self, bits: Int[Array, ""], sound: Bool[Array, ""]
    ) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """Margin and `touching` from the least bits that `crossings` gave; NaN if the input is not sound."""
        sound = sound & (self.size > 0) & jnp.isfinite(self.size)
        cells = jnp.where(sound, jnp.sqrt(jax.lax.bitcast_convert_type(bits, jnp.float32)), jnp.nan)
        return cells * (self.size / _CELLS), ~(cells > TOUCHING * _CELLS)


def linking_of(first: Float[Array, "P 3"], second: Float[Array, "Q 3"]) -> Linking:
    """Linking number of two loops, with its margin; batch it with `jax.vmap`.

    The sign is that of Gauss's integral (1 / 4 pi) oint oint (r1 - r2) . (dr1 x dr2) / |r1 - r2|^3: positive
    where the first loop passes through the second along the second's field (`magnetic_field`). A linking
    number of 0 does not mean unlinked: the Whitehead link has it.

    Args:
        first: a loop, metres: its last point repeats its first.
        second: another one.

    Returns:
        the result; its margin is NaN, and it counts as touching, if a curve is open or not finite.
    """
    grid = Grid.over(jnp.concatenate([first, second]).T)
    numbers, bits = crossings(grid.snap(first.T), grid.snap(second.T))
    margin, touching = grid.margin(jnp.min(bits), is_closed(first) & is_closed(second))
    return Linking(jnp.sum(numbers), margin, touching)


def linking_number(first: ArrayLike, second: ArrayLike) -> int:
    """Signed linking number of two loops, for use outside of jit: `linking_of` with every input checked.

    Raises:
        ValueError: a curve is not a loop (see `check_loop`), or the two touch.
    """
    loops = check_loop(first, "the first loop"), check_loop(second, "the second loop")
    result = jax.jit(linking_of)(*map(jnp.asarray, loops))
    if result.touching:
        raise ValueError(
            f"the loops touch: their least distance is {float(result.margin):.3g}, below {TOUCHING:g} of "
            "their bounding box, so that their linking number is not defined; move them apart"
        )
    return int(result.number)


def check_loop(points: ArrayLike, name: str) -> Float[np.ndarray, "P 3"]:
    """The points as an array, if they are a loop: closed, finite, at least three points, no repeated ones.

    Args:
        points: a polyline, metres, its last point repeating its first.
        name: what an error calls it.

    Raises:
        ValueError: naming the loop, what is wrong with it and where.
    """
    loop = check_points(points, name)
    if len(loop) < 4:
        raise ValueError(f"{name} has {len(loop)} points; expected at least three, and the first one again")
    if (loop[0] != loop[-1]).any():
        raise ValueError(
            f"{name} is open: it begins at {loop[0].tolist()} and ends at {loop[-1].tolist()}; "
            "repeat its first point at its end"
        )
    still = (loop[1:] == loop[:-1]).all(axis=1)
    if still.any():
        raise ValueError(f"{name} has a segment without length at point {np.argmax(still)}; drop that point")
    return loop


def check_points(points: ArrayLike, name: str) -> Float[np.ndarray, "P 3"]:
    """The points as an array, if they are finite and have three coordinates each.

    Raises:
        ValueError: naming them, what is wrong and where.
    """
    try:
        array = np.asarray(points)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name} is no list of points with three coordinates each: {error}") from error
    if array.size == 0:
        return np.zeros((0, 3))
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iuf":
        raise ValueError(
            f"{name} has shape {array.shape} and type {array.dtype}; expected points with three coordinates"
        )
    finite = np.isfinite(array).all(axis=1)
    if not finite.all():
        raise ValueError(f"{name} is not finite at point {np.argmin(finite)}")
    return array.astype(float)


def is_closed(loop: Float[Array, "P 3"]) -> Bool[Array, ""]:
    """Does the last point repeat the first?"""
    return jnp.all(loop[0] == loop[-1])


def crossings(
    curve: Float[Array, "3 P"], loop: Float[Array, "3 Q"]
) -> tuple[Int[Array, "P-1"], Int[Array, "P-1"]]:
    """How often each segment of a polyline passes above a loop, and how near it comes; in a `Grid`'s cells.

    Over the segments of a closed curve the numbers sum to its linking number with the loop. A piece that
    several curves share needs to be looked at only once.

    Returns:
        per segment, the sum of the signs of the crossings at which it is above the loop; and its least
        squared distance from the loop as the bits of a float32. Bits order non-negative floats, and XLA
        vectorises the minimum of integers but not that of floats, which must pass on NaN.
    """
    segments = curve.shape[1] - 1
    curve = jnp.pad(curve, ((0, 0), (0, -segments % _LANES)), mode="edge")
    a, u = tuple(curve[:, :-1]), tuple(curve[:, 1:] - curve[:, :-1])

    def add(total, segment):
        b, v = map(tuple, segment)
        w = tuple(q - p for p, q in zip(a, b, strict=True))
        bits = jax.lax.bitcast_convert_type(_squared_distance(u, v, w), jnp.int32)
        return (total[0] + _crossing(u, v, w), jnp.minimum(total[1], bits)), None

    zero = jnp.zeros(curve.shape[1] - 1, jnp.int32)
    loop_segments = (loop[:, :-1].T, (loop[:, 1:] - loop[:, :-1]).T)
    (numbers, bits), _ = jax.lax.scan(add, (zero, zero + jnp.iinfo(jnp.int32).max), loop_segments)
    return numbers[:segments], bits[:segments]


def _crossing(u, v, w):
    """Sign of the crossing if a + s u passes above b + t v, else 0; w = b - a, all in whole cells."""
    uw, uv, wv = _determinant(u, w), _determinant(u, v), _determinant(w, v)
    # The second curve is moved by (e, e^2) for some infinitely small e > 0; this changes u x w by u x (e,
    # e^2).
    tie_u = (u[1] < 0) | ((u[1] == 0) & (u[0] > 0))
    tie_v = (v[1] > 0) | ((v[1] == 0) & (v[0] < 0))
    from_left, to_left = _is_left(uw, tie_u), _is_left((uw[0] + uv[0], uw[1] + uv[1]), tie_u)
    start_left, end_left = _is_left(wv, tie_v), _is_left((wv[0] - uv[0], wv[1] - uv[1]), tie_v)
    crosses = (from_left ^ to_left) & (start_left ^ end_left)

    # The crossing's place. Where the segments are almost parallel, rounding moves s along both of them; t,
    # and then s again, follow to the place of the other segment beside it, so that both mean the same place.
    s = _held(wv[0] / jnp.where(uv[0] == 0, 1, uv[0]))
    t = _held(((s * u[0] - w[0]) * v[0] + (s * u[1] - w[1]) * v[1]) * _inverse(v[:2]))
    s = _held(((t * v[0] + w[0]) * u[0] + (t * v[1] + w[1]) * u[1]) * _inverse(u[:2]))
    above = s * u[2] > t * v[2] + w[2]
    return jnp.where(crosses & above, jnp.where(to_left, 1, -1), 0)


def _determinant(p, q):
    """p x q seen along z: as float32, in error by at most 2**24, and as int32, exact modulo 2**32."""
    i, j = ([c.astype(jnp.int32) for c in r[:2]] for r in (p, q))
    return p[0] * q[1] - p[1] * q[0], i[0] * j[1] - i[1] * j[0]


def _is_left(determinant, tie):
    """Is this determinant, or sum of two, positive? Exact; `tie` is the answer where it is zero."""
    rounded, wrapped = determinant
    return jnp.where(jnp.abs(rounded) > _SURE, rounded > 0, wrapped + tie > 0)


def _squared_distance(u, v, w):
    """Squared distance between the segments a + s u and b + t v, 0 <= s, t <= 1; w = b - a.

    Ericson (2005), "Real-Time Collision Detection", section 5.1.9: the nearest point of the first line, held
    to its segment; then of the second segment; then of the first again. The first step divides by the squared
    normal, not by u.u v.v - (u.v)^2, which cancels where the segments are almost parallel.
    """
    normal = _cross(u, v)
    s = _held(_dot(_cross(w, v), normal) * _inverse(normal))
    t = _held(_dot([s * p - r for p, r in zip(u, w, strict=True)], v) * _inverse(v))
    beside = [t * q + r for q, r in zip(v, w, strict=True)]
    s = _held(_dot(beside, u) * _inverse(u))
    gap = [r - s * p for r, p in zip(beside, u, strict=True)]
    return _dot(gap, gap)


def _inverse(v):
    """1 / |v|^2, and 1 for the zero vector: the components of v are whole numbers."""
    square = _dot(v, v)
    return 1 / jnp.where(square > 1, square, 1)


def _held(x):
    """x, held between 0 and 1; NaN becomes 1. Passing it on, like `jnp.clip`, takes XLA longer."""
    x = jnp.where(x < 1, x, 1)
    return jnp.where(x > 0, x, 0)


def _dot(p, q):
    return functools.reduce(jnp.add, (x * y for x, y in zip(p, q, strict=True)))


def _cross(p, q):
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]
