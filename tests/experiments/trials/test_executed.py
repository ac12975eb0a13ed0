"""What became of executed transitions, on trials written down by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from doojax.experiments.trials.executed import (
    counts_of,
    execution_errors,
    judged_transitions,
    wrong_among_accepted,
)
from doojax.experiments.trials.records import Event, PlanRecord
from doojax.types import Obstacles
from tests.records import record_of

NOWHERE = Obstacles(
    kind=jnp.zeros(1, jnp.int32),
    centre=jnp.zeros((1, 3)),
    quaternion=jnp.array([[1.0, 0, 0, 0]]),
    half_size=jnp.ones((1, 3)),
    active=jnp.zeros(1, bool),
)


def ropes(*xs):
    """Ropes of two points, both at height x (m)."""
    return np.array([[[x, 0, 0], [x, 1, 0]] for x in xs], np.float32)


def plan(step, *xs):
    """A search at state ``step`` that tried one thing more than what it chose."""
    points = np.concatenate([ropes(*xs), ropes(9.0)])
    count = len(points)
    return PlanRecord(
        step=step,
        parent=np.arange(-1, count - 1),
        points=points,
        grippers=points[:, :1],
        accepted=np.arange(count) < count - 1,
        path=np.arange(count - 1),
    )


def trial(executed, *plans, **about):
    points = ropes(*executed)
    end = Event(len(executed) - 1, "end", "over")
    return record_of(points, obstacles=NOWHERE, plans=plans, events=(end,), about=about)


# A plan of three steps that is left after two, a recovery, and a plan that is right.
RECORD = trial(
    [0.0, 0.1, 0.25, 0.2, 0.3, 0.4],
    plan(0, 0.0, 0.1, 0.2, 0.3),
    plan(2, 0.25),  # stuck: what follows is a recovery
    plan(3, 0.2, 0.3, 0.4),
    error_threshold_m=0.02,
)


def test_errors_are_those_of_what_was_executed_of_each_plan():
    first, stuck, last = execution_errors(RECORD)
    np.testing.assert_allclose(first, [0, 0.05], atol=1e-6)
    assert len(stuck) == 0
    np.testing.assert_allclose(last, [0, 0], atol=1e-6)


def test_wrong_ones_are_counted_until_a_plan_is_off():
    assert judged_transitions(RECORD, 0.02) == (4, 1)
    assert judged_transitions(RECORD, 0.06) == (4, 0)
    late = trial([0.0, 0.1, 0.2, 0.3], plan(0, 0.0, 0.0, 0.2, 0.3))
    assert judged_transitions(late, 0.02) == (1, 1)  # what follows a wrong one is not judged, right or not


def test_a_simulation_that_broke_down_counts_as_wrong():
    assert judged_transitions(trial([0.0, np.nan], plan(0, 0.0, 0.1)), 0.02) == (1, 1)


def test_the_rate_is_of_all_transitions_and_its_interval_of_trials():
    counts = np.array([[4, 1], [10, 0], [0, 0], [6, 1]])
    found = wrong_among_accepted(counts)
    assert found is not None
    assert found.value == pytest.approx(2 / 20) and found.n == 3
    assert found.low < found.value < found.high
    assert wrong_among_accepted(np.zeros((3, 2), int)) is None


def test_an_interval_over_trials_is_wider_than_one_that_takes_transitions_for_independent():
    """Ten wrong of a hundred, all in one trial of ten: the rate may as well be nought."""
    together, apart = np.array([[10, 10]] + [[10, 0]] * 9), np.array([[1, 1]] * 10 + [[1, 0]] * 90)
    one, other = wrong_among_accepted(together), wrong_among_accepted(apart)
    assert one is not None and other is not None
    assert one.value == other.value == 0.1
    assert one.low == 0 < other.low and other.high < one.high


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(0, 1)), min_size=1, max_size=8))
def test_the_interval_holds_the_rate(counts):
    found = wrong_among_accepted(np.array(counts))
    assert found is not None
    assert 0 <= found.low <= found.value + 1e-9 and found.value - 1e-9 <= found.high <= 1


def test_trials_without_a_threshold_count_nothing():
    unjudged = trial([0.0, 0.1], plan(0, 0.0, 0.1))
    assert counts_of([RECORD, unjudged]).tolist() == [[4, 1], [0, 0]]
