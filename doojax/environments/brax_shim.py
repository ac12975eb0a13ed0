"""What the pinned JAX lacks of what brax's training calls; to be removed when brax is mended.

brax 0.14 copies its training state to devices by `jax.device_put_replicated`, which JAX has dropped.
"""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp


def device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """The tree with a first axis, of as many copies as there are devices, each on one of them."""
    mesh = jax.sharding.Mesh(devices, ("copies",))
    spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("copies"))
    return jax.tree.map(
        lambda leaf: jax.device_put(jnp.stack([jnp.asarray(leaf)] * len(devices)), spread), tree
    )


@contextlib.contextmanager
def brax_runs() -> Iterator[None]:
    """For as long as the block lasts, JAX has what brax calls."""
    if hasattr(jax, "device_put_replicated"):
        yield
        return
    jax.device_put_replicated = device_put_replicated  # type: ignore[attr-defined]
    try:
        yield
    finally:
        del jax.device_put_replicated  # type: ignore[attr-defined]
