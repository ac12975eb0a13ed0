"""How varied augmentations are, by hand."""

import numpy as np
import pytest

from doojax.datasets.diversity import divergence, evenly, nearest_distances

BOUNDS = np.array([0.25, 0.0, 0.5])


def test_evenly_spread_transforms_diverge_by_nothing_and_equal_ones_by_all():
    spread = np.linspace(-1, 1, 1001)[:, None] * BOUNDS
    assert divergence(spread, BOUNDS) < 1e-4
    assert divergence(np.zeros((7, 3)), BOUNDS) == pytest.approx(np.log(10))


def test_of_two_cells_of_ten_it_is_the_logarithm_of_five_and_axes_count_alike():
    halves = np.array([[0.2, 0.0, 0.0], [-0.2, 0.0, 0.0]])
    assert divergence(halves, BOUNDS) == pytest.approx((np.log(5) + np.log(10)) / 2)


def test_random_uniform_transforms_have_the_divergence_of_their_number():
    rng = np.random.default_rng(0)
    found = [divergence(rng.uniform(-BOUNDS, BOUNDS, (200, 3)), BOUNDS) for _ in range(200)]
    assert np.mean(found) == pytest.approx(4.5 / 200, rel=0.1)


def test_the_nearest_original_and_how_far_it_is():
    originals = np.zeros((3, 2, 4, 3))  # states, points
    originals[1, ..., 0], originals[2, ..., 1] = 1.0, 2.0
    examples = originals[[2, 1]] + [0.0, 0.0, 0.3]
    examples[1, 0] = originals[1, 0]  # only one of its two states is elsewhere
    gaps, numbers = nearest_distances(examples, originals)
    assert numbers.tolist() == [2, 1]
    np.testing.assert_allclose(gaps, [0.3, 0.3 / np.sqrt(2)])


def test_many_are_looked_at_evenly():
    assert evenly(np.arange(10)).tolist() == list(range(10))
    some = evenly(np.arange(5110))
    assert (len(some), some[0], some[-1]) == (512, 0, 5109) and (np.diff(some) >= 9).all()
