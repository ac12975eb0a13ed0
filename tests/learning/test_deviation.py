"""Labels for estimators of deviation, their loss, and what calibrates them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.learning.calibration import conformal_factor, fit_power
from doojax.learning.deviation import biased_loss, deviation_examples
from tests.learning.slopes import STUCK, Slope, moves, source


def test_the_loss_by_hand():
    # true 0.02 m: (0.01)^2 exp(-50 * 0.02) = 1e-4 / e; without a bias it is the square
    assert float(biased_loss(jnp.asarray(0.03), jnp.asarray(0.02), 50.0)) == pytest.approx(1e-4 / np.e)
    assert float(biased_loss(jnp.asarray(0.03), jnp.asarray(0.02), 0.0)) == pytest.approx(1e-4)


def test_large_deviations_matter_less_and_only_true_ones_say_so():
    """The same gap costs less where the true value is large; a predicted one does not change the weight."""
    gaps = [float(biased_loss(jnp.asarray(d + 0.01), jnp.asarray(d), 50.0)) for d in (0.0, 0.02, 0.1)]
    assert gaps[0] > gaps[1] > gaps[2]
    slope = jax.grad(lambda d: biased_loss(d, jnp.asarray(0.02), 50.0))(jnp.asarray(0.05))
    assert float(slope) == pytest.approx(2 * 0.03 / np.e, rel=1e-5)


def test_examples_begin_at_every_state():
    data = moves(3, length=4)
    found = deviation_examples(source(), data, horizon=1)
    assert len(found) == 12
    factor = np.where(np.asarray(data.states.x[:, 0]) < 0, 1.2, STUCK)
    expected = np.abs((1 - factor)[:, None] * np.asarray(data.actions)[..., 0])
    np.testing.assert_allclose(found.deviation, expected.ravel(), atol=1e-5)
    assert found.trajectory.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    np.testing.assert_array_equal(found.transition.state.x, data.states.x[:, :-1].ravel())


def test_of_two_steps_the_second_begins_where_the_first_was_predicted_to_end():
    data = moves(1, length=3)  # to the left: off by a fifth of what is done
    found = deviation_examples(source(), data, horizon=2)
    x, a = np.asarray(data.states.x[0]), np.asarray(data.actions[0, :, 0])
    np.testing.assert_allclose(
        found.transition.state.x, [x[0], x[0] + a[0], x[1], x[1] + a[1], x[2]], atol=1e-5
    )
    expected = 0.2 * np.abs([a[0], a[0] + a[1], a[1], a[1] + a[2], a[2]])
    np.testing.assert_allclose(found.deviation, expected, atol=1e-5)
    near = deviation_examples(source(), data, horizon=2, kept_below=1e-9)
    np.testing.assert_allclose(near.deviation, expected[[0, 2, 4]], atol=1e-5)  # first steps begin exactly


def test_labels_follow_the_dynamics():
    data = moves(2, factor=1.2)
    before, after = (
        deviation_examples(Slope(jnp.asarray(slope)), data, horizon=2).deviation for slope in (1.0, 1.2)
    )
    assert float(before.max()) > 0.05
    np.testing.assert_allclose(after, 0, atol=1e-5)


def clusters(rng, count, size=8):
    """True values over predicted ones; those of a trajectory are alike."""
    own = rng.normal(0, 0.8, count)
    ratio = np.exp(np.repeat(own, size) + rng.normal(0, 0.3, count * size))
    predicted = rng.uniform(0.001, 0.05, count * size)
    return predicted, predicted * ratio, np.repeat(np.arange(count), size)


@pytest.mark.parametrize("alpha", [0.1, 0.3])
def test_bounds_are_exceeded_as_rarely_as_promised_by_trajectories_that_are_alike(alpha):
    rng = np.random.default_rng(0)
    exceeded, naive = [], []
    for _ in range(400):
        predicted, true, trajectory = clusters(rng, 20)
        new_predicted, new_true, _ = clusters(rng, 20)
        factor = conformal_factor(predicted, true, alpha, trajectory)
        exceeded.append((new_true > factor * new_predicted).mean())
        naive.append((new_true > np.quantile(true / predicted, 1 - alpha) * new_predicted).mean())
    error = np.std(exceeded) / 20
    assert np.mean(exceeded) <= alpha + 2 * error
    assert np.mean(exceeded) >= alpha - 0.06  # not by accepting nothing
    assert np.mean(naive) > np.mean(exceeded)


def test_a_factor_by_hand():
    predicted, trajectory = np.ones(4), np.arange(4)
    true = np.array([1.0, 2.0, 3.0, 4.0])
    # 4 trajectories: with k of them exceeding, the risk is (1 + k) / 5
    assert conformal_factor(predicted, true, 0.25, trajectory) == 4.0  # none may
    assert conformal_factor(predicted, true, 0.41, trajectory) == 3.0  # one may
    assert conformal_factor(predicted, true, 0.1, trajectory) == np.inf  # too few to promise that
    with pytest.raises(ValueError, match=r"alpha is 1\.0, expected a rate between 0 and 1"):
        conformal_factor(predicted, true, 1.0, trajectory)


def test_powers_are_found_again():
    predicted = np.geomspace(1e-3, 0.1, 50)
    power, shift = fit_power(predicted, 2 * predicted**1.5)
    assert power == pytest.approx(1.5, rel=0.01)
    assert np.exp(shift) == pytest.approx(2, rel=0.05)
    assert fit_power(predicted, predicted[::-1])[0] == 0.0  # never turned round
    with pytest.raises(ValueError, match="no examples to calibrate with"):
        fit_power(np.zeros(0), np.zeros(0))
