"""Counts, ranking and calibration, by hand and against brute force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from doojax.learning.calibration import conformal_threshold, fit_calibration
from doojax.learning.metrics import auroc, counts, expected_calibration_error, reliability_diagram
from doojax.models.calibration import Calibration


def test_counts_by_hand():
    accepted = np.array([1, 1, 1, 0, 0, 0, 0], bool)
    right = np.array([1, 1, 0, 1, 0, 0, 0], bool)
    found = counts(accepted, right)
    assert (found.accepted_right, found.accepted_wrong, found.rejected_right, found.rejected_wrong) == (
        2,
        1,
        1,
        3,
    )
    assert found.accuracy == 5 / 7
    assert found.precision == found.recall == 2 / 3
    assert found.specificity == 3 / 4


def test_the_precision_of_a_judge_that_accepts_nothing_is_not_a_number():
    assert np.isnan(counts(np.zeros(3, bool), np.ones(3, bool)).precision)


@given(
    hnp.arrays(int, st.integers(2, 30), elements=st.integers(0, 5)),
    st.integers(0, 2**30),
)
def test_auroc_is_the_chance_that_a_right_one_scores_above_a_wrong_one(scores, seed):
    right = np.random.default_rng(seed).random(len(scores)) < 0.5
    right[:2] = True, False
    pairs = [(p > n) + 0.5 * (p == n) for p in scores[right] for n in scores[~right]]
    assert auroc(scores.astype(float), right) == pytest.approx(np.mean(pairs))


def test_auroc_of_one_class_says_which_is_missing():
    with pytest.raises(ValueError, match="3 right and 0 wrong"):
        auroc(np.arange(3.0), np.ones(3, bool))


def test_calibration_error_by_hand():
    # two bins of 15: around 0.1 none of two is right, around 0.9 one of two
    probabilities = np.array([0.1, 0.1, 0.9, 0.9])
    right = np.array([0, 0, 1, 0], bool)
    mean, true, share = reliability_diagram(probabilities, right)
    np.testing.assert_allclose([mean, true, share], [[0.1, 0.9], [0, 0.5], [0.5, 0.5]])
    assert expected_calibration_error(probabilities, right) == pytest.approx(0.5 * 0.1 + 0.5 * 0.4)


def drawn(count, scale, shift, seed=0):
    """Logits, and labels that are right as often as scale * logit + shift says."""
    rng = np.random.default_rng(seed)
    logits = rng.normal(0, 2, count)
    return logits, rng.random(count) < 1 / (1 + np.exp(-(scale * logits + shift)))


def test_calibration_finds_the_scale_and_the_shift_that_made_the_labels():
    logits, right = drawn(50_000, 0.5, -1.0)
    found = fit_calibration(logits, right)
    assert float(found.scale) == pytest.approx(0.5, abs=0.03)
    assert float(found.shift) == pytest.approx(-1.0, abs=0.04)
    probabilities = np.asarray(found(jnp.asarray(logits)))
    assert expected_calibration_error(probabilities, right) < 0.01
    assert expected_calibration_error(1 / (1 + np.exp(-logits)), right) > 0.1


def test_no_gradient_reaches_a_calibration():
    slopes = jax.grad(lambda model: model(jnp.ones(())))(Calibration(2.0, 0.3))
    assert float(slopes.scale) == float(slopes.shift) == 0


def test_calibration_needs_both_classes():
    with pytest.raises(ValueError, match="all 3 calibration examples are wrong"):
        fit_calibration(np.arange(3.0), np.zeros(3, bool))


def test_the_conformal_threshold_by_hand():
    scores = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4])
    right = np.array([1, 1, 1, 1, 0, 0], bool)
    # (1 + wrong) / accepted, from the top: 1, 1/2, 1/3, 1/4, 2/5, 3/6
    assert conformal_threshold(scores, right, 0.25) == pytest.approx(0.55)
    assert conformal_threshold(scores, right, 0.4) == pytest.approx(0.45)
    assert conformal_threshold(scores, right, 0.2) == float("inf")


def test_equal_scores_are_accepted_together_or_not_at_all():
    scores, right = np.array([0.9, 0.9, 0.9, 0.1]), np.array([1, 1, 0, 1], bool)
    assert conformal_threshold(scores, right, 0.4) == float("inf")  # 2/3 for the three, 2/4 for all
    assert conformal_threshold(scores, right, 0.5) < 0.1


@pytest.mark.parametrize("alpha", [0.0, 1.0, -0.1])
def test_a_rate_that_cannot_be_promised(alpha):
    with pytest.raises(ValueError, match=f"alpha is {alpha}"):
        conformal_threshold(np.ones(2), np.ones(2, bool), alpha)


@pytest.mark.parametrize("alpha", [0.05, 0.2])
def test_the_conformal_promise_holds_on_average_and_is_not_wasteful(alpha):
    wrong = []
    for seed in range(200):
        scores, right = drawn(1000, 1.0, 0.0, seed)
        passed = scores[500:] > conformal_threshold(scores[:500], right[:500], alpha)
        wrong.append((passed & ~right[500:]).sum() / max(passed.sum(), 1))
    error = np.std(wrong) / len(wrong) ** 0.5
    assert 0.6 * alpha < np.mean(wrong) <= alpha + 2 * error


def test_one_more_trajectory_counts_as_wrong_by_hand():
    scores = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4])
    right, trajectory = np.ones(6, bool), np.array([0, 0, 1, 1, 1, 2])
    # transitions a trajectory, from the top: 1, 2, 3/2, 2, 5/2, 2; of the accepted: 1, 1, 1/2, 1/2, 1/2, 1/3
    assert conformal_threshold(scores, right, 0.34, trajectory) < 0.4
    assert conformal_threshold(scores, right, 0.32, trajectory) == float("inf")
    assert conformal_threshold(scores[:5], right[:5], 0.5, trajectory[:5]) < 0.5


@given(st.integers(0, 10_000), st.sampled_from([0.1, 0.3]))
def test_trajectories_of_one_transition_are_as_no_trajectories(seed, alpha):
    scores, right = drawn(60, 2.0, 1.0, seed)
    alone = np.random.default_rng(seed).permutation(60)
    assert conformal_threshold(scores, right, alpha, alone) == conformal_threshold(scores, right, alpha)


@pytest.mark.parametrize("alpha", [0.05, 0.2])
def test_the_promise_is_kept_where_transitions_of_a_trajectory_are_alike(alpha):
    """Ten transitions of a trajectory share what makes them hard. Thresholds from 50 trajectories are tried
    on 50 others, and count where they accept anything; as if all were independent, too much is wrong."""
    kept, naive = [], []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        trajectory = np.repeat(np.arange(100), 10)
        hard, scores = np.repeat(rng.normal(0, 2, 100), 10), rng.normal(0, 1.1, 1000)
        right = rng.random(1000) < 1 / (1 + np.exp(-(2 * scores + hard + 1)))
        for numbers, rates in ((trajectory[:500], kept), (None, naive)):
            passed = scores[500:] > conformal_threshold(scores[:500], right[:500], alpha, numbers)
            if passed.any():
                rates.append((passed & ~right[500:]).sum() / passed.sum())
    assert 0.6 * alpha < np.mean(kept) <= alpha < np.mean(naive)
