"""Who is within reach of whom: sorted rows, windows of fixed size, lists of fixed capacity.

Space is cut into rows along x, as wide as the reach. Particles are sorted by row and by x in it, so that all
that a particle can meet in a row stands in one window of the sorted order, which binary search finds. The
cost is that of the particles' number, times its logarithm. What is found is packed into lists through a
table of the bits of each byte, because a CPU does that many times faster than sorting or scattering.
"""

from itertools import product

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from doojax.geometry.box import Box

BYTE = 8
FEW = 128  # particles
FINE, COARSE = 2**18, 2**10  # parts into which x is cut for sorting, at most and at least
KEYS = 2**31 - 1
_BITS = np.array(
    [sorted(range(BYTE), key=lambda bit, byte=byte: (not byte >> bit & 1, bit)) for byte in range(256)],
    dtype=np.int32,
).reshape(-1)  # of each byte: which bits are set, in order
_COUNTS = np.array([bin(byte).count("1") for byte in range(256)], dtype=np.int32)


class Neighbours(eqx.Module):
    """Of each particle, the numbers of those within reach, itself included, packed; the rest is itself."""

    index: Int[Array, "K P"]
    there: Bool[Array, "K P"]
    dropped: Bool[Array, ""]  # did any have more neighbours, or more in a row, than there is room for?


def rows_of(region: Box, reach: float, dimensions: int) -> list[tuple[float, int]]:
    """Where rows begin, m, and how many there are, along the axes other than x."""
    axes = (2,) if dimensions == 2 else (1, 2)
    found = []
    for axis in axes:
        count = int(np.ceil((region.high[axis] - region.low[axis]) / reach))
        found.append((region.low[axis], count))
    if parts_of(found) < COARSE:
        raise ValueError(
            f"a region of {' by '.join(str(count) for _, count in found)} rows is too large for a reach of "
            f"{reach:.3g} m: expected at most {KEYS // COARSE} rows in all; give a smaller region"
        )
    return found


def parts_of(rows: list[tuple[float, int]]) -> int:
    """Into how many parts x is cut: the more rows there are, the fewer, so that a key is an integer."""
    return min(FINE, KEYS // int(np.prod([count + 2 for _, count in rows])))


def in_order(
    positions: Float[Array, "P D"], reach: float, region: Box
) -> tuple[Int[Array, "P"], Int[Array, "P"], list[Int[Array, "P"]]]:
    """The order of particles by rows and x, their keys in that order, and their rows."""
    rows = rows_of(region, reach, positions.shape[1])
    cells = []
    for axis, (low, count) in enumerate(rows, 1):
        cell = jnp.floor((positions[:, axis] - low) / reach)
        cells.append(jnp.clip(jnp.nan_to_num(cell), 0, count - 1).astype(jnp.int32) + 1)
    parts = parts_of(rows)
    key = _row(cells, rows) * parts + _along(positions[:, 0], region, parts)
    order = jnp.argsort(key)
    return order, key[order], [cell[order] for cell in cells]


def find_neighbours(
    positions: Float[Array, "P D"],
    keys: Int[Array, "P"],
    cells: list[Int[Array, "P"]],
    reach: float,
    region: Box,
    capacity: int,
) -> Neighbours:
    """All pairs within reach, of particles that are sorted by `in_order`.

    Args:
        positions: sorted, m. Outside of the region pairs are found all the same, but they crowd in its edge.
        keys: theirs.
        cells: theirs.
        reach: m.
        region: m.
        capacity: K.
    """
    count, dimensions = positions.shape
    rows = rows_of(region, reach, dimensions)
    x = [positions[:, axis] for axis in range(dimensions)]
    offsets = np.array(sorted(product((-1, 0, 1), repeat=dimensions - 1), key=any), np.int32)  # own row first
    near, there = jnp.zeros((len(offsets), count)), []
    for steps, cell, (low, most), own in zip(offsets.T, cells, rows, x[1:], strict=True):
        # how near the row comes: what is sure to be out of reach along x need not be looked at
        edge, step = low + (cell - 1) * reach, steps[:, None]
        apart = jnp.where(step < 0, own - edge, edge + reach - own) * (step != 0)
        inner = (cell > 1) & (cell < most) & (cell + step > 1) & (cell + step < most)  # edges hold all beyond
        near += jnp.where(inner, jnp.maximum(apart, 0.0), 0.0) ** 2
        there.append(cell + step)
    half = jnp.sqrt(jnp.maximum(reach**2 - near, 0.0))
    parts = parts_of(rows)
    begins = _row(there, rows) * parts
    edges = jnp.stack(
        [begins + _along(x[0] - half, region, parts), begins + _along(x[0] + half, region, parts) + 1]
    )
    method = "compare_all" if count <= FEW else "scan"  # which has a loop
    first, end = jnp.searchsorted(keys, edges, method=method)

    # a row holds twice as many lines of particles in space as in the plane, those beside a corner, too: a
    # particle that is near an edge of its own row has as much of those in reach
    width = 2 if dimensions == 2 else 3  # bytes
    row = np.repeat(np.arange(len(offsets)), width)
    byte = np.tile(np.arange(width), len(offsets))
    starts = first[row] + BYTE * byte[:, None]
    at = starts[:, None] + np.arange(BYTE)[None, :, None]  # [groups, bits, P]
    found = jnp.minimum(at, count - 1)
    square = sum((take(one, found) - one) ** 2 for one in x)
    beside = (square < reach**2) & (at < end[row][:, None])
    bits = (beside * jnp.asarray(2 ** np.arange(BYTE), jnp.int32)[None, :, None]).sum(1)
    more = end - first > BYTE * width
    return _packed(bits, starts, more.any(), capacity)


def _packed(
    bits: Int[Array, "G P"], starts: Int[Array, "G P"], overfull: Bool[Array, ""], capacity: int
) -> Neighbours:
    groups, count = bits.shape
    counts = take(jnp.asarray(_COUNTS), bits)
    ends = jnp.cumsum(counts, axis=0)
    slots, own = jnp.arange(capacity)[:, None], jnp.arange(count)[None]
    group = jnp.minimum((slots[:, None] >= ends[None]).sum(1), groups - 1)
    flat = group * count + own
    before = take((ends - counts).reshape(-1), flat)
    byte, start = take(bits.reshape(-1), flat), take(starts.reshape(-1), flat)
    there = slots < ends[-1][None]
    bit = take(jnp.asarray(_BITS), byte * BYTE + jnp.clip(slots - before, 0, BYTE - 1))
    index = jnp.where(there, jnp.minimum(start + bit, count - 1), own)
    return Neighbours(index, there, overfull | (ends[-1] > capacity).any())


def _row(cells: list[Array], rows: list[tuple[float, int]]) -> Array:
    found = cells[0]
    for cell, (_, count) in zip(cells[1:], rows[1:], strict=True):
        found = found * (count + 2) + cell
    return found


def _along(x: Array, region: Box, parts: int) -> Array:
    part = (x - region.low[0]) / (region.high[0] - region.low[0]) * parts
    return jnp.clip(jnp.nan_to_num(jnp.floor(part)), 0, parts - 1).astype(jnp.int32)


def take(values: Shaped[Array, "n"], index: Int[Array, "*k"]) -> Shaped[Array, "*k"]:
    """``values[index]``, where every index is one."""
    return values.at[index].get(mode="promise_in_bounds")
