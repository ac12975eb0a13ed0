"""Trials on the toy task: what is executed, recorded, counted, and why it ends."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.trials.log import REACHED
from doojax.experiments.trials.record_files import load_record, save_record
from doojax.experiments.trials.replay import replay
from doojax.experiments.trials.setting import Method
from doojax.experiments.trials.trial import STUCK, run_trials
from doojax.simulation.state import Fault
from doojax.tasks.toy import ToySimulator
from tests.planning.problems import BLIND

from .toy_trials import GOALS, METHODS, PLANNING, SETTINGS, SIMULATOR, TOY, Towed, records, trials

EVERY = sorted(METHODS)


def counted(record) -> dict:
    """What a record counts, without the seconds."""
    return {name: value for name, value in record.about.items() if name != "plan_s"}


@pytest.mark.parametrize("method", EVERY)
def test_a_record_tells_what_happened_in_order(method):
    for record, goal in zip(records(method), GOALS, strict=True):
        states, about = len(record.points), record.about
        assert (record.task, record.method) == ("toy", method)
        assert record.goal[:2] == pytest.approx(goal) and record.goal_point == 0
        assert about["actions"] == states - 1 == len(record.replay["actions"]) <= SETTINGS.actions
        assert about["searches"] == len(record.plans) <= SETTINGS.searches
        shortcuts = PLANNING.shortcuts * PLANNING.lanes * SETTINGS.actions
        assert about["extensions"] <= len(record.plans) * (PLANNING.extensions + shortcuts)

        kinds, steps = [event.kind for event in record.events], [event.step for event in record.events]
        assert steps == sorted(steps) and kinds.index("end") == len(kinds) - 1
        assert kinds.count("plan") == len(record.plans)
        assert kinds.count("recover") == about["recovery_actions"]
        assert record.end == about["end"] and record.reached == (record.end == REACHED)

        missing = np.linalg.norm(record.points[-1, 0] - record.goal)
        assert about["final_error_m"] == pytest.approx(missing, abs=1e-6)
        assert record.reached == (missing <= TOY.goal_threshold)
        for plan in record.plans:  # begins where the rope was
            assert np.array_equal(plan.points[0], record.points[plan.step])
            assert np.array_equal(plan.path, sorted(plan.path)) and plan.path[0] == 0


@pytest.mark.parametrize("method", EVERY)
def test_a_saved_trial_is_executed_again_to_the_same_states(method, tmp_path):
    for index, record in enumerate(records(method)):
        save_record(tmp_path / f"{index}.npz", record)
        again = replay(SIMULATOR, load_record(tmp_path / f"{index}.npz"))
        assert np.array_equal(again, record.points)


def test_with_the_truth_what_was_planned_happens():
    for record in records("oracle"):
        for plan in record.plans:
            executed = record.points[plan.step : plan.step + len(plan.path)]
            assert np.array_equal(plan.points[plan.path][: len(executed)], executed)
    assert sum(record.reached for record in records("oracle")) >= 2


def test_without_a_classifier_the_plan_goes_through_the_wall_and_the_rope_does_not():
    crossing = records("no_classifier")[1]
    plan = crossing.plans[0]
    planned = plan.points[plan.path[-1], -1]
    executed = crossing.points[len(plan.path) - 1, -1]
    assert np.linalg.norm(planned - executed) > 0.05


def steps_of_plans(record):
    """Of every plan's executed steps: its number, all bodies before and after, and as they were planned."""
    executed = np.concatenate([record.points, record.grippers], axis=1)
    ends = [*(plan.step for plan in record.plans[1:]), len(executed) - 1]
    for number, (plan, end) in enumerate(zip(record.plans, ends, strict=True)):
        planned = np.concatenate([plan.points, plan.grippers], axis=1)[plan.path]
        for step in range(min(len(planned) - 1, end - plan.step)):
            before, after = executed[plan.step + step : plan.step + step + 2]
            yield number, before, after, planned[step : step + 2]


def rms(vectors):
    return np.sqrt((vectors**2).sum(-1).mean(-1))


def test_what_refuted_the_model_is_not_planned_again_while_the_trial_lasts():
    crossing = records("no_classifier")[1]
    assert crossing.about["refuted"] > 0 and crossing.about["searches"] > 1
    known = []  # of every refuted step: its plan, where it began, what was predicted, and the error of that
    for number, before, after, (begins, ends) in steps_of_plans(crossing):
        change = ends - begins
        for plan, where, predicted, error in known:
            alike = rms(begins - where) < 0.499 * error and rms(change - predicted) < 0.499 * error
            assert not alike or number == plan  # what was planned before it was refuted
        error = rms(after - before - change)
        if error > TOY.goal_threshold / 2:
            known.append((number, before, change, error))
    assert len(known) == crossing.about["refuted"]


def test_a_trial_ends_when_the_goal_is_reached_also_between_two_actions():
    # a plan ends within 15 cm of the goal, but the rope is there from 25 cm on
    wide = trials()
    goals = eqx.tree_at(lambda g: g.tolerance, wide.goals, 5 * wide.goals.tolerance)
    ran = run_trials(TOY, SIMULATOR, METHODS["classifier"], PLANNING, SETTINGS, wide._replace(goals=goals))
    left = 0
    for record in ran:
        missing = np.linalg.norm(record.points[:, 0] - record.goal, axis=-1)
        inside = np.flatnonzero(missing <= 5 * TOY.goal_threshold)
        assert record.reached and inside[0] == len(missing) - 1
        if record.plans:
            last = record.plans[-1]
            left += len(last.path) - len(missing) + last.step
    assert left > 0  # actions of plans that were not needed


def test_the_same_seeds_give_the_same_trials_whatever_runs_beside_them():
    moved = trials(goals=(GOALS[0], (0.4, -0.4), GOALS[2]))
    again = run_trials(TOY, SIMULATOR, METHODS["classifier"], PLANNING, SETTINGS, moved)
    for index in (0, 2):
        first, second = records("classifier")[index], again[index]
        assert np.array_equal(first.points, second.points)
        assert first.events == second.events and counted(first) == counted(second)
    other = trials()._replace(numbers=[17, 18, 19])
    other = run_trials(TOY, SIMULATOR, METHODS["classifier"], PLANNING, SETTINGS, other)
    assert [r.events for r in other] != [r.events for r in records("classifier")]


def test_without_recovery_a_stuck_trial_is_given_up():
    for record in records("timid"):
        assert record.end == STUCK and record.about["actions"] == 0 and record.about["searches"] == 1
        assert not record.plans[0].accepted[1:].any()


def test_recovery_acts_once_a_search_until_the_budget_is_spent():
    for record in records("random_recovery"):
        assert record.about["recovery_actions"] == record.about["actions"] == SETTINGS.searches
        assert record.end == "4 searches did not suffice"


def test_the_budget_of_actions_holds_within_a_plan():
    (record, *_) = run_trials(
        TOY, SIMULATOR, METHODS["no_classifier"], PLANNING, replace(SETTINGS, actions=2), trials()
    )
    assert record.about["actions"] == 2 and record.end == "2 actions did not suffice"


def test_execution_stops_where_the_rope_leaves_the_plan():
    settings = replace(SETTINGS, replan_distance=0.03)
    watched = run_trials(TOY, SIMULATOR, METHODS["no_classifier"], PLANNING, settings, trials())[1]
    first = next(event for event in watched.events if event.kind == "replan")
    plan = max((p for p in watched.plans if p.step < first.step), key=lambda p: p.step)
    off = np.sqrt(((plan.points[first.step - plan.step] - watched.points[first.step]) ** 2).sum(-1).mean())
    assert off > 0.03
    assert first.text == f"{100 * off:.1f} cm from where the plan had the rope"
    before = plan.points[first.step - plan.step - 1] - watched.points[first.step - 1]
    assert np.sqrt((before**2).sum(-1).mean()) <= 0.03
    assert any(p.step == first.step for p in watched.plans)  # a new search from there


class Fragile(ToySimulator):
    """Breaks down where the gripper comes near the middle."""

    ends: float = jnp.nan  # m, where it finds itself then

    def step(self, state, action):
        after = super().step(state, action)
        near = jnp.linalg.norm(self.observe(after).grippers[0, :2]) < 0.25
        faults = jnp.where(near, int(Fault.NOT_FINITE), 0).astype(jnp.int32)
        qpos = jnp.where(near, self.ends, after.qpos)
        return eqx.tree_at(lambda s: (s.qpos, s.faults), after, (qpos, faults))


@pytest.mark.parametrize("ends", [np.nan, 1e4])
def test_a_simulation_that_breaks_down_ends_its_trial_alone(tmp_path, ends):
    fragile = Fragile(scene=TOY.scene, phase="constrained", ends=ends)
    method = Method("blind", Towed(), BLIND)
    ran = run_trials(TOY, fragile, method, PLANNING, SETTINGS, trials())
    ends = [record.end for record in ran]
    assert "the simulation became unstable" in ends and len(set(ends)) > 1
    broken = ran[ends.index("the simulation became unstable")]
    assert not (np.abs(broken.points[-1]) < 1e3).any() and (np.abs(broken.points[:-1]) < 10).all()
    before = np.linalg.norm(broken.points[-2] - broken.goal, axis=-1)  # of the last sound state
    assert broken.about["final_error_m"] == pytest.approx(before[TOY.goal_point]) and not broken.reached
    save_record(tmp_path / "broken.npz", broken)  # it can be kept and looked at


def test_a_record_without_its_actions_cannot_be_executed_again():
    with pytest.raises(ValueError, match="holds no first state and no actions"):
        replay(SIMULATOR, replace(records("timid")[0], replay={}))
