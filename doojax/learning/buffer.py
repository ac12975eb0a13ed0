"""Examples that come in while learning goes on: in so many places, so that nothing compiles anew."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


class Buffer(eqx.Module):
    """Up to C examples with their weights; once they are that many, new ones take the place of the oldest.

    It is data: `added` gives another buffer of the same shapes, whatever it holds.
    """

    items: Any  # a pytree whose leaves begin with axis C
    weight: Float[Array, "C"]  # how often each is drawn beside the others; 0 in empty places
    count: Int[Array, ""]  # of all that were ever added

    @classmethod
    def like(cls, examples: Any, capacity: int) -> "Buffer":
        """An empty one for examples such as these, whose leaves have a leading axis.

        Raises:
            ValueError: for a capacity below 1.
        """
        if capacity < 1:
            raise ValueError(f"capacity is {capacity}, expected at least 1")
        empty = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape[1:]), leaf.dtype), examples)
        return cls(empty, jnp.zeros(capacity), jnp.zeros((), jnp.int32))

    @classmethod
    def of(cls, examples: Any, capacity: int | None = None) -> "Buffer":
        """One that holds n examples of weight one, n at least 1, in so many places; by default in n.

        Raises:
            ValueError: for no examples, or more than there are places.
        """
        count = len(jax.tree.leaves(examples)[0])
        places = count if capacity is None else capacity
        if not 1 <= count <= places:
            raise ValueError(f"there are {count} examples for {places} places, expected 1 to {places}")

        def padded(leaf: Array) -> Array:  # in numpy, which compiles nothing for another number of them
            held = np.asarray(leaf)
            empty = np.zeros((places - count, *held.shape[1:]), held.dtype)
            return jnp.asarray(np.concatenate([held, empty]))

        weight = jnp.asarray((np.arange(places) < count).astype(np.float32))
        return cls(jax.tree.map(padded, examples), weight.astype(float), jnp.asarray(count, jnp.int32))

    @property
    def capacity(self) -> int:
        """C."""
        return self.weight.shape[0]

    def added(
        self,
        examples: Any,
        weight: Float[Array, "n"] | None = None,
        *,
        keep: Bool[Array, "n"] | None = None,
    ) -> "Buffer":
        """The buffer with n more examples.

        Args:
            examples: whose leaves have a leading axis n.
            weight: of each; one by default.
            keep: which of them are added; by default all. The others take no place, and shapes stay alike.

        Raises:
            ValueError: more examples than there are places.
        """
        number = len(jax.tree.leaves(examples)[0])
        if number > self.capacity:
            raise ValueError(f"{number} examples are more than the buffer's {self.capacity} places")
        weight = jnp.ones(number) if weight is None else weight
        return _added(self, examples, weight, jnp.ones(number, dtype=bool) if keep is None else keep)

    def drawn(self, steps: int, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Places of examples for each of some batches, each as often as its weight says, with replacement."""
        return weighted(self.weight, steps, batch_size, key=key)


@jax.jit
def _added(buffer: Buffer, examples: Any, weight: Float[Array, "n"], keep: Bool[Array, "n"]) -> Buffer:
    rank = jnp.cumsum(keep)
    places = jnp.where(keep, (buffer.count + rank - 1) % buffer.capacity, buffer.capacity)

    def put(old: Array, new: Array) -> Array:
        return old.at[places].set(new, mode="drop")

    items = jax.tree.map(put, buffer.items, examples)
    return Buffer(items, put(buffer.weight, weight), buffer.count + rank[-1].astype(jnp.int32))


def weighted(
    weight: Float[Array, "n"], steps: int, batch_size: int, *, key: Array
) -> Int[Array, "steps batch"]:
    """Numbers of examples, drawn with replacement in proportion to their weights; one must be positive."""
    total = jnp.cumsum(weight)
    draws = total[-1] * jax.random.uniform(key, (steps, batch_size))
    # Rounding may put a draw at the very end, behind the last example with a weight.
    last = jnp.max(jnp.where(weight > 0, jnp.arange(len(weight)), 0))
    return jnp.minimum(jnp.searchsorted(total, draws, side="right"), last)
