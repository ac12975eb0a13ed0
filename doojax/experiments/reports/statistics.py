"""Estimates with intervals, and tests of methods that were tried on the same scenes.

Methods share scenes, so every test is paired: what counts is how the two did on the same scene. All tests
are two-sided. The released code of the thesis has an unpaired t test of which it ignores the sign.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

RESAMPLES = 9999


class Estimate(NamedTuple):
    """A figure with its 95 % interval."""

    value: float
    low: float
    high: float
    n: int


class PairedTest(NamedTuple):
    """How a method differs from another on the same scenes, and how likely chance does that."""

    difference: Estimate  # first less second
    p_value: float


def success_rate(success: Bool[np.ndarray, "n"]) -> Estimate:
    """The rate of successes, with Wilson's score interval.

    Raises:
        ValueError: for no trials.
    """
    _require_trials(success)
    result = stats.binomtest(int(success.sum()), len(success))
    interval = result.proportion_ci(0.95, method="wilson")
    return Estimate(float(success.mean()), float(interval.low), float(interval.high), len(success))


def bootstrap(
    values: Float[np.ndarray, "n"], statistic: Callable[..., np.ndarray] = np.mean, *, seed: int = 0
) -> Estimate:
    """A statistic with the interval of a percentile bootstrap (Efron 1979).

    Args:
        values: the sample.
        statistic: np.mean, np.median, np.std, ...; it takes an ``axis``.
        seed: of the resampling.

    Raises:
        ValueError: for an empty sample.
    """
    _require_trials(values)
    rng = np.random.default_rng(seed)
    samples = values[rng.integers(0, len(values), (RESAMPLES, len(values)))]
    low, high = np.quantile(statistic(samples, axis=-1), [0.025, 0.975])
    return Estimate(float(statistic(values)), float(low), float(high), len(values))


def mcnemar(first: Bool[np.ndarray, "n"], second: Bool[np.ndarray, "m"]) -> PairedTest:
    """Do two methods succeed equally often? McNemar's test, exact.

    Only the scenes count on which one succeeds and the other fails: were the methods equal, either would be
    as likely.

    Raises:
        ValueError: for no scenes, or unequal numbers.
    """
    _require_pairs(first, second)
    won, lost = int((first & ~second).sum()), int((~first & second).sum())
    p_value = stats.binomtest(won, won + lost).pvalue if won + lost else 1.0
    return PairedTest(bootstrap(first.astype(float) - second.astype(float)), float(p_value))


def signed_rank(first: Float[np.ndarray, "n"], second: Float[np.ndarray, "m"]) -> PairedTest:
    """Are the differences of paired values centred at zero? Wilcoxon's signed-rank test.

    Equal values are left out. The estimate is of the median difference.

    Raises:
        ValueError: for no scenes, or unequal numbers.
    """
    _require_pairs(first, second)
    differences = first - second
    different = differences[differences != 0]
    p_value = np.asarray(stats.wilcoxon(different))[1] if different.size else 1.0
    return PairedTest(bootstrap(differences, np.median), float(p_value))


def permutation(
    first: Float[np.ndarray, "n"], second: Float[np.ndarray, "m"], *, seed: int = 0
) -> PairedTest:
    """Is the mean of paired differences zero? Permutation test that swaps the members of pairs.

    Exact for up to 13 pairs, else from 9,999 random swaps; p then is never below 1/10,000.

    Raises:
        ValueError: for no scenes, or unequal numbers.
    """
    _require_pairs(first, second)
    differences = first - second
    if len(differences) == 1:  # swapped or not, it is as far from zero
        return PairedTest(bootstrap(differences), 1.0)
    result = stats.permutation_test(
        (differences,),
        np.mean,
        permutation_type="samples",
        vectorized=True,
        n_resamples=RESAMPLES,
        rng=np.random.default_rng(seed),
    )
    return PairedTest(bootstrap(differences), float(result.pvalue))


def paired_t(first: Float[np.ndarray, "n"], second: Float[np.ndarray, "m"]) -> PairedTest:
    """Is the mean of paired differences zero? Student's t test, which takes them to be normal.

    Of few pairs it can be surer than tests without that assumption, whose p is at least 2 / 2^n.

    Raises:
        ValueError: for no scenes, or unequal numbers.
    """
    _require_pairs(first, second)
    if len(first) == 1:
        return PairedTest(bootstrap(first - second), 1.0)
    return PairedTest(bootstrap(first - second), float(stats.ttest_rel(first, second).pvalue))


def success_curve(
    errors: Float[np.ndarray, "n"], thresholds: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "k"]:
    """The rate of trials whose final error (m) is at most each threshold (m): thesis Fig. 2.6."""
    _require_trials(errors)
    return np.searchsorted(np.sort(errors), thresholds, side="right") / len(errors)


def _require_trials(values: np.ndarray) -> None:
    if values.ndim != 1 or not len(values):
        raise ValueError(f"there are values of shape {values.shape}, expected one for each of some trials")


def _require_pairs(first: np.ndarray, second: np.ndarray) -> None:
    _require_trials(first)
    if first.shape != second.shape:
        raise ValueError(
            f"paired tests need the same scenes: one method has {len(first)} trials, the other {len(second)}"
        )
