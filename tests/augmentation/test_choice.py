"""Which of several augmentations is taken: by chance, the rarer the likelier, so that they become uniform."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.augmentation.choice import augment_evenly, rarity
from doojax.augmentation.examples import Augmented
from doojax.datasets.diversity import divergence
from doojax.keys import numbered, stream
from doojax.types import Verdict

BOUNDS = np.array([0.2, 0.1, 0.0, 0.0, 0.0, 0.5])
COUNT = 2000


def shortened(keys) -> Augmented:
    """As a projection makes them: uniform, times a random length; one in four is rejected."""

    def one(key):
        target, length, refused = jax.random.split(key, 3)
        aim = jax.random.uniform(target, (6,), minval=-1.0) * BOUNDS
        rejected = jax.random.uniform(refused) < 0.25
        found = jnp.where(rejected, jnp.nan, aim * jax.random.uniform(length) ** 0.5)
        verdict = jnp.where(rejected, int(Verdict.BOX), int(Verdict.ACCEPTED))
        return Augmented(None, jnp.zeros((1, 1, 3)), found, jnp.zeros(3), aim, verdict, jnp.array(1))

    return jax.jit(jax.vmap(one))(keys)


def accepted(found: Augmented) -> np.ndarray:
    return np.asarray(found.transform)[np.asarray(found.verdict) == Verdict.ACCEPTED]


def test_rarity_by_hand():
    # Of 20 along x, 19 in the first tenth and one in the last: each tenth counts one more, 30 in all, so
    # 30 / (10 * 20), 30 / (10 * 2), and 3 where nothing was seen.
    transforms = np.zeros((20, 6))
    transforms[:, 0] = [-0.2] * 19 + [0.2]
    found = rarity(transforms, np.array([0.2, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(found[0], [0.15, *[3.0] * 8, 1.5])
    np.testing.assert_array_equal(found[1:], 1.0)


def test_of_several_one_is_taken_so_that_what_is_accepted_is_uniform():
    pilot = accepted(shortened(numbered(stream(0, "test", "pilot"), range(COUNT))))
    weights, found = rarity(pilot, BOUNDS), {}
    for tries in (1, 8):
        keys = numbered(stream(0, "test"), range(COUNT))
        found[tries] = accepted(augment_evenly(shortened, keys, weights, BOUNDS, tries))
    assert len(found[1]) == pytest.approx(0.75 * COUNT, rel=0.05) and len(found[8]) > 0.999 * COUNT - 2
    assert divergence(found[1], BOUNDS) > 0.1
    assert divergence(found[8], BOUNDS) < 0.2 * divergence(found[1], BOUNDS)


def test_each_depends_on_its_own_key_alone():
    weights, keys = np.ones((6, 10)), lambda: numbered(stream(1, "test"), range(64))
    whole, part = (augment_evenly(shortened, some, weights, BOUNDS, 3) for some in (keys(), keys()[10:20]))
    for all_of_them, some in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
        np.testing.assert_array_equal(all_of_them[10:20], some)


def test_two_are_taken_in_proportion_to_their_weights():
    """The first in the cell of weight 3, the second in that of weight 1: three times in four the first."""
    weights = np.ones((6, 10))
    weights[0, 0] = 3.0
    calls = iter((-0.2, 0.2) * 2)

    def given(keys):
        place = jnp.zeros((len(keys), 6)).at[:, 0].set(next(calls))
        rest = jnp.zeros((len(keys), 1, 1, 3)), place, jnp.zeros((len(keys), 3)), place
        full = jnp.full(len(keys), int(Verdict.ACCEPTED))
        return Augmented(None, *rest, full, full)

    keys = numbered(stream(2, "test"), range(4 * COUNT))
    found = augment_evenly(given, keys, weights, np.array([0.2, 0, 0, 0, 0, 0]), 2)
    assert float((found.transform[:, 0] < 0).mean()) == pytest.approx(0.75, abs=0.02)
