"""Exact linking numbers of closed polylines.

A loop is an array ``[P, 3]`` whose last point repeats its first. To pad a loop, repeat its last point again:
segments without length change neither linking numbers nor distances.

How the number is found. A plane x = const sweeps over both curves. In it, each point of the first curve has a
difference (y, z) from each point of the second; while the plane moves, the differences draw closed polygons,
which meet the origin only where the curves meet. The linking number is how often the polygons turn around the
origin, and that is counted, in whole numbers, where they cross the half-axis y = 0, z > 0.

Why it is exact. No integral is approximated and nothing is rounded to an integer in the end. The curves are
snapped to a cubic grid, 2**20 cells along the longest side of their bounding box. Where the plane cuts a
segment, y is rounded to a whole cell, in the same way for all pairs of segments that share the place
(`_crossing`). So the polygons stay closed, and their sides match, whatever the rounding; it only moves them,
by less than five cells. The number is proven when the curves stay ten cells apart, which is `TOUCHING`;
closer ones are reported. So are those that are no farther apart than their coordinates may have been rounded:
float32 is fine near the origin, but of map coordinates it keeps half a metre. `linking_number` subtracts the
middle of what it is given in double precision; subtract before you make arrays of JAX.
"""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from doojax.geometry.rounding import rounding
from doojax.modules import Jittable

Points = np.ndarray | Array | Sequence[Any]
"""What an unchecked polyline or point may be given as: an array, or lists of numbers."""

TOUCHING = 1e-5
"""Curves closer than this fraction of the longest side of their bounding box are reported as touching."""

_CELLS = 2.0**20
_APART = (
    3**0.5
)  # each coordinate of either point moves by half of the distance between floating-point numbers
_LANES = 16  # XLA's loops on a CPU handle what is left over from a multiple of this one by one


class Linking(eqx.Module):
    """How two loops are linked, and how sure that is."""

    number: Int[Array, "*b"]  # signed linking number; reversing one of the loops flips its sign
    margin: Float[Array, "*b"]  # least distance between the curves, metres, to 2e-6 of their bounding box
    touching: Bool[Array, "*b"]
    """The number is void: the margin is not above `TOUCHING` of the bounding box, or not above what the
    coordinates may have been rounded by, far from the origin."""


class Grid(Jittable):
    """The grid that curves are snapped to before they are compared."""

    corner: Float[Array, "3"]
    size: Float[Array, ""]  # longest side of the bounding box, metres
    rounding: Float[Array, ""]  # by so much may two points have come nearer when they were rounded, metres

    @staticmethod
    def over(points: Float[Array, "3 P"]) -> "Grid":
        """The grid over the bounding box of points. One row per axis, here and below, vectorises best."""
        low, high = jnp.min(points, axis=1), jnp.max(points, axis=1)
        largest = jnp.maximum(jnp.max(jnp.abs(low)), jnp.max(jnp.abs(high)))
        return Grid(low, jnp.max(high - low), _APART * jnp.finfo(points.dtype).eps * largest)

    def snap(self, points: Float[Array, "3 P"]) -> Float[Array, "3 P"]:
        """Coordinates in cells: whole numbers, as float32."""
        return jnp.round((points - self.corner[:, None]) * (_CELLS / self.size)).astype(jnp.float32)

    def margin(
        self, square: Float[Array, ""], sound: Bool[Array, ""]
    ) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """Margin and `touching` from a squared distance in cells; NaN if the input is not sound."""
        sound = sound & (self.size > 0) & jnp.isfinite(self.size)
        cells = jnp.where(sound, jnp.sqrt(square), jnp.nan)
        metres = cells * (self.size / _CELLS)
        return metres, ~((cells > TOUCHING * _CELLS) & (metres > self.rounding))


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
    numbers, squares = crossings(grid.snap(first.T), grid.snap(second.T))
    margin, touching = grid.margin(jnp.min(squares), is_closed(first) & is_closed(second))
    return Linking(jnp.sum(numbers), margin, touching)


def linking_number(first: Points, second: Points) -> int:
    """Signed linking number of two loops, for use outside of jit: `linking_of` with every input checked.

    Loops in double precision may be anywhere, such as in map coordinates.

    Raises:
        ValueError: a curve is not a loop (see `check_loop`), or the two touch, or they are given in single
            precision, too far from the origin to tell.
    """
    loops = check_loop(first, "the first loop"), check_loop(second, "the second loop")
    both = np.concatenate(loops)
    middle = (both.min(axis=0) + both.max(axis=0)) / 2
    result = jax.jit(linking_of)(*(jnp.asarray(loop - middle) for loop in loops))
    if result.touching:
        raise ValueError(
            f"the loops touch: their least distance is {float(result.margin):.3g}, below {TOUCHING:g} of "
            "their bounding box, so that their linking number is not defined; move them apart"
        )
    lost = _APART * max(rounding(loop, own=True) for loop in map(np.asarray, (first, second)))
    if not result.margin > lost:
        raise ValueError(
            f"the loops are {float(result.margin):.3g} m apart, but single precision rounds coordinates of "
            f"up to {np.abs(both).max():.9g} m by as much: give them in double precision (numpy.float64), "
            "or subtract a common origin before they are rounded"
        )
    return int(result.number)


def check_loop(points: Points, name: str) -> Float[np.ndarray, "P 3"]:
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


def check_points(points: Points, name: str) -> Float[np.ndarray, "P 3"]:
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
) -> tuple[Int[Array, "P-1"], Float[Array, "P-1"]]:
    """What each segment of a polyline adds to its linking number with a loop, and how near it comes.

    Over the segments of a closed curve the numbers sum to the linking number. A piece that several curves
    share needs to be looked at only once. Takes five bytes per pair of segments.

    Args:
        curve: in cells of a `Grid`; where pieces of it meet, their points must be equal.
        loop: in cells of the same grid.

    Returns:
        per segment, its number, and its least squared distance from the loop.
    """
    count = curve.shape[1] - 1
    curve = jnp.pad(curve, ((0, 0), (0, -count % _LANES)), mode="edge")
    own = _Segments.of(curve[:, None, :-1], (curve[:, 1:] - curve[:, :-1])[:, None])
    other = _Segments.of(loop[:, :-1, None], (loop[:, 1:] - loop[:, :-1])[..., None])
    # Without the barrier XLA computes the pairs inside of the two reductions, which vectorises them badly.
    numbers, squares = jax.lax.optimization_barrier(
        (_crossing(own, other).astype(jnp.int8), _squared_distance(own, other))
    )
    return jnp.sum(numbers, axis=0, dtype=jnp.int32)[:count], jnp.min(squares, axis=0)[:count]


class _Segments(eqx.Module):
    """One segment or several. Vectors are tuples: axes of length three would spoil vectorisation."""

    start: tuple[Array, Array, Array]
    step: tuple[Array, Array, Array]
    inverse_square: Array  # of the length
    low: Array  # range along x
    high: Array
    inverse_x: Array  # 1 / extent along x, 0 for those without
    upright: Array  # 1 for those without extent along x, else 0
    way: Array  # sign of the extent along x

    @staticmethod
    def of(start: Float[Array, "3 *p"], step: Float[Array, "3 *p"]) -> "_Segments":
        (x, y, z), (dx, dy, dz) = start, step
        end, upright = x + dx, dx == 0
        return _Segments(
            start=(x, y, z),
            step=(dx, dy, dz),
            inverse_square=_inverse_square((dx, dy, dz)),
            low=jnp.minimum(x, end),
            high=jnp.maximum(x, end),
            inverse_x=jnp.where(upright, 0, 1 / jnp.where(upright, 1, dx)),
            upright=upright.astype(x.dtype),
            way=jnp.where(dx < 0, -1, 1),
        )


def _crossing(a: _Segments, b: _Segments) -> Array:
    """+1 or -1 if the differences of points of two segments cross the upper half-axis, else 0.

    From the plane that first meets both segments to the one that last does, their difference moves straight.
    Either end of this way belongs to a vertex of one curve and a segment of the other, and is an end of the
    next pair's way, too. Both pairs must see it on the same side of the half-axis, so they must compute the
    same y. They do: coordinates are whole, and exact in float32; s * step is made by multiplications alone,
    which a compiler cannot fuse in one place and not in the other; and rounding makes it the step itself
    where the segment ends, since s is 1 there to within 3 / 2**23.
    """
    # Vertices of both curves in one plane: the second is moved along x by an infinitely small amount.
    meets = (a.low <= b.high) & (b.low < a.high)

    def difference(x, is_end):
        s = (x - a.start[0]) * a.inverse_x + is_end * a.upright
        t = (x - b.start[0]) * b.inverse_x + is_end * b.upright
        y = (a.start[1] - b.start[1]) + (jnp.round(s * a.step[1]) - jnp.round(t * b.step[1]))
        return y, (a.start[2] - b.start[2]) + (s * a.step[2] - t * b.step[2])

    start_y, start_z = difference(jnp.maximum(a.low, b.low), 0)
    end_y, end_z = difference(jnp.minimum(a.high, b.high), 1)
    starts_left, ends_left = start_y < 0, end_y < 0
    above = (start_z * end_y > end_z * start_y) == starts_left
    crosses = meets & (starts_left ^ ends_left) & above
    return jnp.where(crosses, jnp.where(starts_left, -1, 1) * a.way * b.way, 0)


def _squared_distance(a: _Segments, b: _Segments) -> Array:
    """Squared distance between two segments.

    Ericson (2005), "Real-Time Collision Detection", section 5.1.9: the nearest point of the first line, held
    to its segment; then of the second segment; then of the first again. The first step divides by the squared
    normal, not by u.u v.v - (u.v)^2, which cancels where the segments are almost parallel.
    """
    u, v = a.step, b.step
    w = [q - p for p, q in zip(a.start, b.start, strict=True)]
    normal = _cross(u, v)
    s = _held(_dot(_cross(w, v), normal) * _inverse_square(normal))
    t = _held(_dot([s * p - r for p, r in zip(u, w, strict=True)], v) * b.inverse_square)
    beside = [t * q + r for q, r in zip(v, w, strict=True)]
    s = _held(_dot(beside, u) * a.inverse_square)
    gap = [r - s * p for r, p in zip(beside, u, strict=True)]
    return _dot(gap, gap)


def _inverse_square(v):
    """1 / |v|^2, and 1 for the zero vector: the components of v are whole numbers."""
    square = _dot(v, v)
    return 1 / jnp.where(square > 1, square, 1)


def _held(x):
    """x, held between 0 and 1; NaN becomes 1. Passing it on, as `jnp.clip` does, takes XLA longer."""
    x = jnp.where(x < 1, x, 1)
    return jnp.where(x > 0, x, 0)


def _dot(p, q):
    return functools.reduce(jnp.add, (x * y for x, y in zip(p, q, strict=True)))


def _cross(p, q):
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]
