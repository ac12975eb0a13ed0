"""What was tried at each command, in a trial's record: there and back, and told where it does not fit."""

from dataclasses import replace

import numpy as np
import pytest

from doojax.experiments.trials.record_files import load_record, save_record
from doojax.experiments.trials.records import Event, TrialRecord
from doojax.experiments.trials.tried import Tried, costs_by_term, tried_in
from tests.records import record_of

T, K, H, J = 3, 5, 2, 20


def tried() -> Tried:
    random = np.random.default_rng(0)
    return Tried(
        tried=random.uniform(-1.5, 1.5, (T, K, H, 3)),
        tried_cost=np.sort(random.uniform(0, 9, (T, K)), axis=1),
        planned=random.uniform(-1.5, 1.5, (T, H, 3)),
        planned_joints=random.uniform(-3, 3, (T, H, J)),
        planned_tool=random.uniform(-1.5, 1.5, (T, H, 3)),
        terms={"reaching": np.array([3.0, 2.0, 1.0]), "near": np.array([0.0, 3.0, 0.0])},
    )


def record(replay=None, about=None) -> TrialRecord:
    return record_of(
        np.zeros((T + 1, 4, 3), np.float32),
        task="arm_reaching",
        method="mppi",
        goal=np.array([0.0, 0.5, 0.7]),
        goal_point=3,
        grippers=np.zeros((T + 1, 2, 3), np.float32),
        events=(Event(T, "end", "the goal is reached"),),
        reached=True,
        about=about or {},
        replay=replay or {},
    )


def test_what_was_tried_comes_back_to_half_a_millimetre(tmp_path):
    given = tried()
    save_record(tmp_path / "trial.npz", record(given.packed()))
    found = tried_in(load_record(tmp_path / "trial.npz"))
    assert found is not None
    for name in ("tried", "planned", "planned_tool"):
        np.testing.assert_allclose(getattr(found, name), getattr(given, name), atol=5e-4)
    np.testing.assert_allclose(found.planned_joints, given.planned_joints, atol=1e-3)
    np.testing.assert_allclose(found.tried_cost, given.tried_cost, rtol=1e-6)
    assert sum(values.nbytes for values in given.packed().values()) < 3000


def test_costs_stand_at_the_states_that_commands_were_made_in():
    costs = costs_by_term(record(tried().packed()))
    np.testing.assert_array_equal(costs["reaching"], [3, 2, 1, np.nan])
    np.testing.assert_array_equal(costs["near"], [0, 3, 0, np.nan])
    # of trials that regrasp: steps say how many states there were once they were executed
    steps = [{"step": 1, "cost_torn": 4.0}, {"step": 3, "cost_torn": 5.0, "to_goal": 1.0}]
    costs = costs_by_term(record(about={"steps": steps}))
    np.testing.assert_array_equal(costs["torn"], [4, np.nan, 5, np.nan])
    assert list(costs) == ["torn"] and costs_by_term(record()) == {} and tried_in(record()) is None


@pytest.mark.parametrize(
    ("name", "values", "told"),
    [
        ("planned", None, "has what was tried, but no planned$"),
        ("tried_cost", np.zeros((T, K + 1)), r"tried_cost is float64 \(3, 6\), expected floats \(3, 5\)"),
        ("tried", np.zeros((T, K), np.float16), r"tried is float16 \(3, 5\), expected floats"),
        ("term_near", np.zeros(T, int), r"term_near is int64 \(3,\), expected floats \(3,\)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(name, values, told):
    replay = {**tried().packed(), name: values}
    with pytest.raises(ValueError, match=told):
        tried_in(record({key: value for key, value in replay.items() if value is not None}))
    shorter = record(tried().packed())
    with pytest.raises(ValueError, match="3 commands were tried for, expected 1, one a step"):
        points, hands = shorter.points[:2], shorter.grippers[:2]
        tried_in(replace(shorter, points=points, grippers=hands, events=()))
