"""Estimates and paired tests, against numbers worked by hand, textbook data and other formulas."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from doojax.experiments.reports import statistics


def outcomes(both: int, first: int, second: int, neither: int) -> tuple[np.ndarray, np.ndarray]:
    """Two methods' successes with these four counts."""
    one = [True] * both + [True] * first + [False] * second + [False] * neither
    other = [True] * both + [False] * first + [True] * second + [False] * neither
    return np.array(one), np.array(other)


def test_wilson_interval_by_hand():
    """8 of 10: (p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n), z = 1.959964."""
    estimate = statistics.success_rate(np.array([True] * 8 + [False] * 2))
    z, n, p = 1.959964, 10, 0.8
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    assert estimate.value == 0.8 and estimate.n == 10
    assert (estimate.low, estimate.high) == pytest.approx((middle - half, middle + half), abs=1e-6)
    assert (estimate.low, estimate.high) == pytest.approx((0.4902, 0.9433), abs=1e-4)


def test_mcnemar_by_hand():
    """6 scenes won, 1 lost: p = 2 (C(7,0) + C(7,1)) / 2^7 = 16/128. Equal outcomes do not count."""
    for both, neither in ((0, 0), (40, 3)):
        assert statistics.mcnemar(*outcomes(both, 6, 1, neither)).p_value == pytest.approx(0.125)
    test = statistics.mcnemar(*outcomes(10, 6, 1, 3))
    assert test.difference.value == pytest.approx(5 / 20)
    assert test.difference.low < 5 / 20 < test.difference.high
    assert statistics.mcnemar(*outcomes(5, 0, 0, 5)).p_value == 1.0


def test_the_threshold_of_the_issue_can_be_met():
    """p < 0.001 needs at least 11 scenes won and none lost: 2/2^11 = 0.00098."""
    assert statistics.mcnemar(*outcomes(100, 11, 0, 0)).p_value == pytest.approx(2**-10)
    assert statistics.mcnemar(*outcomes(100, 10, 0, 0)).p_value > 0.001


def test_signed_rank_by_hand():
    """Differences 1, 2, 3, -4 have the rank sum W- = 4; of the 16 equally likely sign patterns,
    those with W <= 4 are {}, 1, 2, 3, 4, 1+2, 1+3: p = 2 * 7/16."""
    second = np.zeros(4)
    first = np.array([1.0, 2.0, 3.0, -4.0])
    assert statistics.signed_rank(first, second).p_value == pytest.approx(14 / 16)
    with_ties = np.append(first, 0.0), np.append(second, 0.0)
    assert statistics.signed_rank(*with_ties).p_value == pytest.approx(14 / 16)


def test_permutation_by_hand():
    """Differences 1, 2, 3: of the 8 sign patterns, +++ has the largest mean: p = 2/8."""
    assert statistics.permutation(np.array([1.0, 2.0, 3.0]), np.zeros(3)).p_value == pytest.approx(0.25)


def test_darwins_maize():
    """Fisher's analysis of Darwin's 15 pairs (The Design of Experiments, 1935, section 21): 863 of the 32,768
    sign patterns have a sum at least as large, so that p = 2 * 863 / 32768 = 0.0527."""
    eighths = np.array([49, -67, 8, 16, 6, 23, 28, 41, 14, 29, 56, 24, 75, 60, -48])
    test = statistics.permutation(eighths / 8, np.zeros(15))
    assert test.p_value == pytest.approx(2 * 863 / 32768, abs=0.007)  # 9,999 of the 32,768 patterns
    assert test.difference.value == pytest.approx(2.617, abs=1e-3)  # inches


def test_equal_methods_are_never_told_apart():
    values = np.arange(9.0)
    assert statistics.signed_rank(values, values).p_value == 1.0
    assert statistics.permutation(values, values).p_value == 1.0


def test_tests_do_not_depend_on_the_order_of_scenes_and_turn_with_the_methods():
    rng = np.random.default_rng(0)
    first, second = rng.normal(0.3, 1, 30), rng.normal(0, 1, 30)
    order = rng.permutation(30)
    there, back = statistics.signed_rank(first, second), statistics.signed_rank(second, first)
    assert there.p_value == pytest.approx(back.p_value)
    assert there.difference.value == -back.difference.value
    assert statistics.signed_rank(first[order], second[order]).p_value == pytest.approx(there.p_value)


def test_the_bootstrap_covers_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(60):
        estimate = statistics.bootstrap(rng.normal(2.0, 1.0, 50))
        covered += estimate.low < 2.0 < estimate.high
    assert covered >= 51  # of 60 at 95 %, a binomial count below 51 has probability 0.0005


def test_the_bootstrap_agrees_with_the_normal_interval_of_a_mean():
    values = np.random.default_rng(2).normal(0, 1, 400)
    estimate = statistics.bootstrap(values)
    half = 1.96 * values.std() / 20
    assert (estimate.low, estimate.high) == pytest.approx(
        (values.mean() - half, values.mean() + half), abs=0.006
    )
    assert statistics.bootstrap(values) == estimate  # the same seed


@given(
    errors=st.lists(st.floats(0, 1), min_size=1, max_size=30),
    thresholds=st.lists(st.floats(0, 1), min_size=1, max_size=5),
)
def test_the_success_curve_counts(errors, thresholds):
    curve = statistics.success_curve(np.array(errors), np.array(thresholds))
    for threshold, rate in zip(thresholds, curve, strict=True):
        assert rate == sum(error <= threshold for error in errors) / len(errors)


@pytest.mark.parametrize("test", [statistics.signed_rank, statistics.permutation])
def test_unequal_numbers_of_trials_are_refused(test):
    with pytest.raises(ValueError, match="one method has 3 trials, the other 4"):
        test(np.zeros(3), np.zeros(4))
    with pytest.raises(ValueError, match="some trials"):
        test(np.zeros(0), np.zeros(0))
