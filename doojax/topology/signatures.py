"""The grasp loop signature as a value: a multiset of vectors of linking numbers, and lists of such values."""

import itertools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from doojax.modules import Jittable


class Signature(eqx.Module):
    """A multiset of at most L vectors, one per grasp loop: its linking numbers with S obstacle loops.

    The arrays are canonical: equal multisets of one shape have equal `rows`. Outside of jit a single
    signature compares with ``==``, also to one of another L, hashes, and prints as ``{(1,0),(0,1)}``; without
    any grasp loop it prints as ``∅``, which differs from ``{(0,0)}``, a loop linked with nothing. One that is
    not to be trusted prints with ``touching`` behind it. In jit use `same`.
    """

    rows: Int[Array, "*b L S"]  # in descending order; -1 in rows that are not used
    count: Int[Array, "*b"]  # number of grasp loops
    margin: Float[
        Array, "*b"
    ]  # least distance of a grasp loop from an obstacle loop, metres; inf without any
    touching: Bool[Array, "*b"]  # some two loops touch, or input was malformed (margin NaN): do not trust it

    @staticmethod
    def of(vectors: Sequence[Sequence[int]], obstacle_loops: int) -> "Signature":
        """A given multiset, such as a goal: ``Signature.of([(1, 0), (0, 1)], 2)``; ``[]`` is the empty one.

        Raises:
            ValueError: a vector has another length than `obstacle_loops`, or a negative or fractional entry.
        """
        for vector in vectors:
            whole = all(isinstance(entry, int | np.integer) and entry >= 0 for entry in vector)
            if len(vector) != obstacle_loops or not whole:
                raise ValueError(
                    f"{tuple(vector)} is not a vector of a signature; expected {obstacle_loops} whole "
                    "numbers, none negative, one per obstacle loop"
                )
        rows = np.array(sorted(map(tuple, vectors), reverse=True), np.int32).reshape(
            len(vectors), obstacle_loops
        )
        return Signature(
            jnp.asarray(rows), jnp.asarray(len(vectors)), jnp.asarray(jnp.inf), jnp.asarray(False)
        )

    @property
    def vectors(self) -> tuple[tuple[int, ...], ...]:
        """The elements of a single signature as Python integers, in descending order."""
        rows = np.asarray(self.rows)
        if rows.ndim != 2:
            raise ValueError(f"this is a batch of signatures, of shape {rows.shape[:-2]}; choose one of them")
        if not rows.shape[1]:
            return ((),) * int(self.count)
        return tuple(tuple(row) for row in rows.tolist() if row[0] >= 0)

    def __eq__(self, other: object) -> bool:
        """Are these the same multisets? Margins do not matter."""
        if not isinstance(other, Signature):
            return NotImplemented
        return self.rows.shape[-1] == other.rows.shape[-1] and self.vectors == other.vectors

    def __hash__(self) -> int:
        """Equal for equal signatures."""
        return hash(self.vectors)

    def __str__(self) -> str:
        """The multiset as it is written on paper."""
        elements = ",".join(f"({','.join(map(str, vector))})" for vector in self.vectors)
        return (f"{{{elements}}}" if elements else "∅") + (" touching" if self.touching else "")


def canonical(numbers: Int[Array, "L S"], used: Bool[Array, "L"]) -> tuple[Int[Array, "L S"], Int[Array, ""]]:
    """Rows and count of the signature that the used rows of `numbers` make."""
    rows = jnp.where(used[:, None], numbers, -1)
    if rows.shape[1]:
        rows = rows[jnp.lexsort(rows.T[::-1])[::-1]]
    return rows, jnp.sum(used)


def same(first: Signature, second: Signature) -> Bool[Array, ""]:
    """Are two signatures equal? For jit; outside, ``==`` says so too.

    Raises:
        ValueError: they count different numbers of obstacle loops.
    """
    first_rows, second_rows = _alike(first, second)
    return jnp.all(first_rows == second_rows) & (first.count == second.count)


def distance(first: Signature, second: Signature) -> Int[Array, ""]:
    """How different two signatures are: 0 if they are equal; a metric.

    The least sum over the ways to pair their vectors, of the entries' absolute differences; a vector without
    partner adds one more than the sum of its entries. Takes time and memory in L!; L is a small number.

    Raises:
        ValueError: they count different numbers of obstacle loops.
    """
    first_rows, second_rows = _alike(first, second)
    slots = jnp.arange(len(first_rows))
    first_used, second_used = (slots < s.count for s in (first, second))
    # A slot that is not used stands for "no loop". One more entry, 1 for a loop, tells it from a zero vector.
    one, other = (
        jnp.concatenate([jnp.maximum(rows, 0), used[:, None]], axis=1)
        for rows, used in ((first_rows, first_used), (second_rows, second_used))
    )
    costs = jnp.sum(jnp.abs(one[:, None] - other[None]), axis=-1)
    pairings = np.array(list(itertools.permutations(range(len(slots)))), int)
    return jnp.min(jnp.sum(costs[slots, pairings], axis=-1))


def _alike(first: Signature, second: Signature) -> tuple[Int[Array, "L S"], Int[Array, "L S"]]:
    """The rows of both, with as many slots in one as in the other."""
    (first_slots, loops), (second_slots, other_loops) = first.rows.shape, second.rows.shape
    if loops != other_loops:
        raise ValueError(
            f"signatures over {loops} and over {other_loops} obstacle loops cannot be compared: "
            "take both with the same skeleton"
        )
    slots = max(first_slots, second_slots)
    pad = lambda rows: jnp.pad(rows, ((0, slots - len(rows)), (0, 0)), constant_values=-1)  # noqa: E731
    return pad(first.rows), pad(second.rows)


class Blocklist(Jittable):
    """Up to C distinct signatures that a planner shall not try again. Immutable: `add` returns a new one."""

    entries: Signature  # with C as batch axis
    length: Int[Array, ""]  # so many of them are used

    @staticmethod
    def empty(capacity: int, like: Signature) -> "Blocklist":
        """A list for `capacity` signatures of the shape of a given one."""
        copies = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (capacity, *leaf.shape)), like)
        return Blocklist(copies, jnp.asarray(0))

    def contains(self, signature: Signature) -> Bool[Array, ""]:
        """Is this signature on the list?"""
        matches = jax.vmap(same, (None, 0))(signature, self.entries)
        return jnp.any(matches & (jnp.arange(len(matches)) < self.length))

    def add(self, signature: Signature) -> "Blocklist":
        """The list with this signature on it; unchanged if it was there.

        Raises:
            ValueError: the signature has another shape than those on the list.
            RuntimeError: the list is full; under jit as well, by `equinox.error_if`.
        """
        capacity, *shape = self.entries.rows.shape
        if signature.rows.shape != tuple(shape):
            raise ValueError(
                f"the signature has shape {signature.rows.shape}, those on the blocklist have "
                f"{tuple(shape)}: make the list with Blocklist.empty(capacity, like=signature)"
            )
        known = self.contains(signature)
        length = eqx.error_if(
            self.length,
            ~known & (self.length == capacity),
            f"the blocklist is full with {capacity} signatures: make it with a larger capacity",
        )
        place = jnp.where(known, capacity, length)  # beyond the end: dropped
        entries = jax.tree.map(lambda old, new: old.at[place].set(new, mode="drop"), self.entries, signature)
        return Blocklist(entries, length + ~known)
