"""Of several augmentations of an example, one that makes accepted transforms more uniform.

The projection shortens transforms: targets are uniform, and what comes of them crowds about the identity. How
much is learned from a few examples first; then several targets are tried for each augmentation, and of those
accepted one is chosen by chance, the likelier the rarer its transform is.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from doojax.augmentation.examples import Augmented
from doojax.datasets.diversity import CELLS
from doojax.types import Verdict


def rarity(transforms: Float[np.ndarray, "N 6"], bounds: Float[np.ndarray, "6"]) -> Float[np.ndarray, "6 10"]:
    """One over how often each tenth of each axis occurs, within ``bounds`` either way, relative to uniform.

    Each tenth counts one more than it was seen, so that no weight is infinite; axes along which nothing is
    moved have ones.
    """
    found = np.ones((len(bounds), CELLS))
    for axis in np.flatnonzero(bounds):
        counts = np.bincount(_cells(transforms[:, axis], bounds[axis]), minlength=CELLS) + 1
        found[axis] = counts.sum() / (CELLS * counts)
    return found


def augment_evenly(
    augment: Callable[[Key[Array, "B"]], Augmented],
    keys: Key[Array, "B"],
    weights: Float[np.ndarray, "6 10"],
    bounds: Float[np.ndarray, "6"],
    tries: int,
) -> Augmented:
    """Of as many augmentations of each example as ``tries``, one; each depends on its own key alone.

    Args:
        augment: one augmentation of each example, from the keys of its targets.
        keys: of the examples.
        weights: of the tenths of each axis, as `rarity` gives them.
        bounds: of translation (m) and rotation vector (rad), either way.
        tries: at least 1.

    Returns:
        One of those accepted, with a probability in proportion to the product of its tenths' weights; where
        none is, the first.
    """
    own = jax.vmap(lambda key: jax.random.split(key, tries + 1))(keys)
    found = [augment(own[:, number]) for number in range(tries)]
    chance = np.asarray(jax.vmap(lambda key: jax.random.uniform(key, (tries,)))(own[:, tries]), np.float64)
    weight = np.stack([_weight(one, weights, bounds) for one in found], axis=1)
    # the largest of u^(1/w) is the i-th with probability w_i / sum w
    best = np.where(weight > 0, np.log(np.maximum(chance, 1e-12)) / np.maximum(weight, 1e-300), -np.inf)
    which, rows = jnp.asarray(best.argmax(1)), jnp.arange(len(best))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[which, rows], *found)


def _weight(
    found: Augmented, weights: Float[np.ndarray, "6 10"], bounds: Float[np.ndarray, "6"]
) -> Float[np.ndarray, "B"]:
    transforms = np.nan_to_num(np.asarray(found.transform))
    product = np.ones(len(transforms))
    for axis in np.flatnonzero(bounds):
        product = product * weights[axis][_cells(transforms[:, axis], bounds[axis])]
    return np.where(np.asarray(found.verdict) == Verdict.ACCEPTED, product, 0.0)


def _cells(values: Float[np.ndarray, "N"], bound: float) -> np.ndarray:
    share = (np.asarray(values, np.float64) / bound + 1) / 2
    return np.clip((share * CELLS).astype(int), 0, CELLS - 1)
