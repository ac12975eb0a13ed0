"""Trials of a robot that is off, on the toy task."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.online.experience import trajectory_of
from doojax.experiments.trials.execution import distances
from doojax.experiments.trials.record_files import load_record, save_record
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.replay import replay
from doojax.experiments.trials.trial import crashed, run_trials
from doojax.experiments.trials.truth import AS_SEEN, with_truth
from doojax.simulation.tracking import EXACT, Tracked, Tracking

from .toy_trials import METHODS, PLANNING, SETTINGS, SIMULATOR, TOY, records, trials

OFF = Tracking(hand_error=0.02, point_error=0.01, camera=(0.0, 0.0, 2.0))


@pytest.fixture(scope="module")
def of_robot():
    return run_trials(TOY, Tracked(SIMULATOR, OFF), METHODS["classifier"], PLANNING, SETTINGS, trials())


def test_a_robot_without_errors_does_what_the_simulator_does():
    exact = run_trials(TOY, Tracked(SIMULATOR, EXACT), METHODS["classifier"], PLANNING, SETTINGS, trials())
    for one, other in zip(exact, records("classifier"), strict=True):
        assert np.array_equal(one.points, other.points) and one.reached == other.reached
        assert one.about["final_error_m"] == pytest.approx(one.about["seen_error_m"], abs=1e-6)


def test_records_hold_what_was_known_and_judge_by_the_truth(of_robot):
    for record in of_robot:
        missing = np.linalg.norm(record.points[-1, record.goal_point] - record.goal)
        assert record.about["seen_error_m"] == pytest.approx(missing, abs=1e-6)
        assert abs(record.about["final_error_m"] - missing) > 1e-5
        assert record.reached == (missing <= TOY.goal_threshold >= record.about["final_error_m"])
        assert record.end == record.about["end"]
        learned = trajectory_of(record)  # what is learned from is what was known
        assert learned is not None and np.array_equal(learned.states.points[0], record.points)


@pytest.mark.slow
def test_a_goal_that_is_only_seen_to_be_reached_is_not_reached(of_robot):
    robot, given = Tracked(SIMULATOR, OFF), trials()
    reached = [record for record in records("classifier") if record.reached][:1] * 3
    assert len(reached) == 3
    states = robot.begun(given.starts, jax.random.split(jax.random.key(0), 3))  # far from every goal
    far = np.asarray(distances(given.goals, robot.truth(states)))
    for record, error in zip(with_truth(reached, robot, states, given), far, strict=True):
        assert error > TOY.goal_threshold and not record.reached
        assert record.end == record.about["end"] == AS_SEEN
        assert record.about["final_error_m"] == pytest.approx(float(error))


def test_trials_of_a_robot_are_executed_again_to_what_was_known(of_robot, tmp_path):
    for index, record in enumerate(of_robot):
        save_record(tmp_path / f"{index}.npz", record)
        loaded = load_record(tmp_path / f"{index}.npz")
        assert isinstance(loaded, TrialRecord)
        again = replay(SIMULATOR, loaded)
        assert np.allclose(again, record.points, atol=1e-6)


def test_errors_depend_on_the_trial_alone(of_robot):
    given = trials()
    later = jax.tree.map(lambda leaf: leaf[jnp.array([2, 0, 1])], (given.starts, given.goals))
    turned = given._replace(starts=later[0], goals=later[1], numbers=[9, 7, 8])
    found = run_trials(TOY, Tracked(SIMULATOR, OFF), METHODS["classifier"], PLANNING, SETTINGS, turned)
    for one, place in zip(found, (2, 0, 1), strict=True):
        assert np.allclose(one.points[0], of_robot[place].points[0])


def test_a_trial_of_a_robot_that_an_error_ends_is_recorded():
    record = crashed(TOY, Tracked(SIMULATOR, OFF), METHODS["timid"], trials(), ValueError("no"), "...")
    assert record.end.startswith("crashed: ValueError: no") and not record.reached
