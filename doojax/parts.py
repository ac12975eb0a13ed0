"""A batch in small parts, a thread for each processor: on a CPU faster than the whole batch in one call.

What a part needs stays in a core's cache; a loop runs for as long as its slowest element, so that fewer
elements wait for one another; and XLA, which cuts each operation of a large batch up among threads, gains
little by that where operations are short.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def splits(size: int, *arguments: Any) -> bool:
    """Would `in_parts` be faster than one call? Never on an accelerator, nor while JAX traces the caller."""
    leaves = jax.tree.leaves(arguments)
    traced = any(isinstance(leaf, Tracer) for leaf in leaves)
    return not traced and len(leaves[0]) > size and jax.default_backend() == "cpu"


def in_parts(function: Callable[..., Any], size: int, *arguments: Any) -> Any:
    """``function(*arguments)``, ``size`` elements at a time.

    Args:
        function: of trees of arrays with a common first axis, whose elements do not know of each other; gives
            such a tree, without random keys.
        size: of a part; all parts have it, so that one is compiled.
        arguments: at least ``size`` elements of each.
    """
    batch = len(jax.tree.leaves(arguments)[0])
    firsts = range(0, batch, size)
    # The last part overlaps the one before, lest it has another shape.
    pieces = [_piece(arguments, size, jnp.asarray(min(first, batch - size))) for first in firsts]
    wide, device = jax.config.jax_enable_x64, jax.config.jax_default_device

    def run(piece: Any) -> Any:
        with jax.enable_x64(wide), jax.default_device(device):  # a thread begins without them
            return jax.tree.map(np.asarray, function(*piece))

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        found = list(pool.map(run, pieces))
    known = size * len(firsts) - batch  # elements that the last part has twice
    found[-1] = jax.tree.map(lambda leaf: leaf[known:], found[-1])
    return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *found)


@partial(jax.jit, static_argnums=1)
def _piece(tree: Any, size: int, first: jax.Array) -> Any:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, size), tree)
