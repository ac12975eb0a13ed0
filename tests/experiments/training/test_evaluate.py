"""Figures of judges: what is promised, what was counted, and what an interval is over."""

import numpy as np
import pytest

from doojax.experiments.training.evaluate import promise_rows, resampled

TAGS = {"task": "toy", "model": "classifier"}


def promise(accepted, right, trajectory):
    rows = promise_rows(
        np.asarray(accepted, bool), np.asarray(right, bool), np.asarray(trajectory), TAGS, 0.1, 0
    )
    return {row.metric: row for row in rows}


def test_a_promise_is_checked_by_counting_once():
    found = promise([1, 1, 1, 1, 0, 0], [1, 1, 1, 0, 0, 1], [0, 0, 1, 1, 2, 2])
    assert found["conformal_violation"].value == 1 / 4  # one wrong of four accepted
    assert found["conformal_accepted_fraction"].value == pytest.approx(4 / 6)
    assert found["conformal_violation"].n == 3  # trajectories, not transitions or repeats
    assert found["conformal_violation"].tags["alpha"] == 0.1


def test_where_nothing_is_accepted_there_is_no_rate():
    assert set(promise([0, 0], [1, 0], [0, 1])) == {"conformal_accepted_fraction"}


def test_an_interval_knows_that_transitions_of_a_trajectory_are_alike():
    """The same transitions, ten times in every trajectory: ten times as many, but no more is known."""
    rng = np.random.default_rng(0)
    right = rng.random(40) < 0.8
    accepted, numbers = np.ones(40, bool), np.arange(40)
    one = promise(accepted, right, numbers)["conformal_violation"]
    alike = promise(np.repeat(accepted, 10), np.repeat(right, 10), np.repeat(numbers, 10))
    apart = promise(np.repeat(accepted, 10), np.repeat(right, 10), np.arange(400))
    width = {
        name: row.high - row.low
        for name, row in (
            ("one", one),
            ("alike", alike["conformal_violation"]),
            ("apart", apart["conformal_violation"]),
        )
    }
    assert width["alike"] == pytest.approx(width["one"], rel=1e-6)
    assert width["apart"] < 0.5 * width["alike"]


def test_samples_of_trajectories_have_the_right_mean_and_spread():
    """Half of the 50 trajectories are right throughout: the share of right ones is binomial."""
    trajectory = np.repeat(np.arange(50), 4)
    right = trajectory < 25
    drawn = resampled(trajectory, np.ones(200, bool), right, 0)
    assert np.mean(drawn.precision) == pytest.approx(0.5, abs=0.01)
    assert np.std(drawn.precision) == pytest.approx((0.25 / 50) ** 0.5, rel=0.1)
