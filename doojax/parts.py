"""Work for all processors: a batch in small parts, a thread for each processor.

On a CPU that is usually faster than the whole batch in one call. What a part needs stays in a core's cache; a
loop runs for as long as its slowest element, so that fewer elements wait for one another; and XLA, which cuts
each operation of a large batch up among threads, gains little by that where operations are short.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads[T, R](function: Callable[[T], R], items: Iterable[T], threads: int | None = None) -> list[R]:
    """``function`` of each item, in the items' order; by default one thread for each processor.

    Threads compute in the caller's precision and on the caller's default device, which JAX would forget. The
    first error is raised when what had begun has ended.
    """
    wide, device = jax.config.jax_enable_x64, jax.config.jax_default_device

    def run(item: T) -> R:
        with jax.enable_x64(wide), jax.default_device(device):
            return function(item)

    with ThreadPoolExecutor(threads or processors()) as pool:
        return list(pool.map(run, items))


def worth_parts(size: int, batch: Any, *others: Any) -> bool:
    """Is ``batch`` larger than a part, and a call of `in_parts` wise?

    It is not on an accelerator, nor for a batch that is spread over devices already, nor while JAX traces:
    ``others`` is what else might be traced.
    """
    leaves = jax.tree.leaves(batch)
    if any(
        isinstance(leaf, jax.Array) and not isinstance(leaf, Tracer) and len(leaf.devices()) > 1
        for leaf in leaves
    ):
        return False
    return not traced(batch, others) and len(leaves[0]) > size and jax.default_backend() == "cpu"


def traced(*trees: Any) -> bool:
    """Is this called inside of `jax.jit` or another transformation, or with something that is?"""
    return any(isinstance(leaf, Tracer) for leaf in (*jax.tree.leaves(trees), jnp.zeros(())))


def in_parts(function: Callable[..., Any], size: int, *arguments: Any) -> Any:
    """``function(*arguments)``, ``size`` elements at a time.

    Args:
        function: of trees of arrays with a common first axis, whose elements do not know of each other; gives
            such a tree, without random keys.
        size: of a part; all parts have it, so that one is compiled.
        arguments: at least ``size`` elements of each.

    Returns:
        the whole batch's results, on the default device.

    Raises:
        ValueError: if the arguments differ in length, or are shorter than a part.
    """
    lengths = {len(leaf) for leaf in jax.tree.leaves(arguments)}
    if len(lengths) != 1 or min(lengths) < size:
        raise ValueError(
            f"the first axes have lengths {sorted(lengths)}, expected one length, of at least {size}"
        )
    (batch,) = lengths
    firsts = range(0, batch, size)
    # The last part overlaps the one before, lest it has another shape.
    pieces = [_piece(arguments, size, jnp.asarray(min(first, batch - size))) for first in firsts]
    found = in_threads(lambda piece: jax.tree.map(np.asarray, function(*piece)), pieces)
    known = size * len(firsts) - batch  # elements that the last part has twice
    found[-1] = jax.tree.map(lambda leaf: leaf[known:], found[-1])
    return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *found)


@partial(jax.jit, static_argnums=1)
def _piece(tree: Any, size: int, first: jax.Array) -> Any:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, size), tree)
