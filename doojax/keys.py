"""Named streams of random numbers: what is random comes from a seed and from what it is for.

`jax.random.split(k, n)[i]` is `jax.random.fold_in(k, i)`, so two modules that both begin with the same seed
and split it draw the same numbers. Streams of different names never coincide, whatever is done with them.
"""

import hashlib
import json

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

MOST = 2**63  # seeds are smaller


def stream(seed: int, *names: str) -> Key[Array, ""]:
    """The random key for one purpose.

    Its bits are the first 64 of the SHA-256 of seed and names, the same in every process and on every
    machine. The whole seed counts: 0 and 2^32 differ.

    Args:
        seed: at least 0 and below 2^63.
        names: what the numbers are for, from the general to the particular: "collect", "rope_dragging".

    Raises:
        ValueError: for a seed out of range, or without a name.
    """
    words = np.frombuffer(_digest(seed, names)[:8], dtype="<u4").astype(np.uint32)
    return jax.random.wrap_key_data(jnp.asarray(words), impl="threefry2x32")


def numbered(key: Key[Array, ""], numbers: Array | np.ndarray | range) -> Key[Array, "n"]:
    """The keys of elements with these numbers, 0 to 2^32 - 1: each depends on its own number alone."""
    numbers = np.asarray(numbers, dtype=np.uint32) if isinstance(numbers, range) else numbers
    return jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)


def generator(seed: int, *names: str) -> np.random.Generator:
    """The same for numpy. Errors as for `stream`."""
    return np.random.default_rng(int.from_bytes(_digest(seed, names), "little"))


def check_seed(seed: int) -> int:
    """The seed, if it is one.

    Raises:
        ValueError: it is not a whole number from 0 to 2^63 - 1.
    """
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < MOST:
        raise ValueError(f"the seed is {seed!r}, expected a whole number from 0 to 2^63 - 1")
    return seed


def _digest(seed: int, names: tuple[str, ...]) -> bytes:
    if not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f"the names of a stream are {names!r}, expected one or more words: what it is for")
    return hashlib.sha256(json.dumps([check_seed(seed), *names]).encode()).digest()
