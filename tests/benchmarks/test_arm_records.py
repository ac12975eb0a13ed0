"""Records of trials of arms: of each command the best samples, the plan rolled out, costs by term."""

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.benchmarks import arm_control
from doojax.benchmarks.arm_control import Sampled, Trial
from doojax.benchmarks.arm_records import Watched, record_of, recorded
from doojax.benchmarks.mppi import mppi
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.tried import tried_in
from doojax.planning.mppi import Nominal, Report, Samples
from doojax.planning.simulated import Tried
from doojax.tasks.arm_reaching import ArmReaching, Reaching
from doojax.types import ArmsState

K, H, N = 3, 2, 4


def rolled(points, joints) -> Tried:
    shape = points.shape[:2]
    tools = jnp.stack([jnp.zeros((*shape, 3)), points[:, :, 0]], axis=2)
    return Tried(ArmsState(points, tools, joints), jnp.zeros(shape, int), jnp.zeros(shape), jnp.zeros(shape))


class Given(Sampled):
    """Samples whose outcome is given, and a plan whose rollout is."""

    def __init__(self, points, costs, planned):
        samples = Samples(jnp.zeros((K, H, 16)), jnp.ones(K))
        weights = jnp.array([0.75, 0.25, 0.0])
        terms = {"reaching": jnp.array([1.0, 3.0, jnp.nan])}
        report = Report(samples, rolled(points, jnp.zeros((K, H, 20))), terms, costs, weights)
        self.last = Nominal(jnp.full((H, 16), 0.5), jnp.ones(16), jnp.asarray(0.2)), report
        self.rollouts = self
        self.planned = planned

    def many(self, state, controls, durations):
        assert controls.shape == (1, H, 16) and float(controls.min()) == 0.5
        return rolled(self.planned, jnp.full((1, H, 20), 0.25))


@pytest.fixture(scope="module")
def task():
    return ArmReaching()


def test_the_best_samples_come_first_and_costs_are_weighted(task):
    points = jnp.arange(K * H * N * 3, dtype=float).reshape(K, H, N, 3)
    given = Given(points, jnp.array([5.0, 2.0, jnp.nan]), points[:1] + 0.5)
    watched = Watched()
    for _ in range(2):
        watched(given, task.settled, jnp.ones(18))
    found = watched.tried
    assert found is not None and found.tried.shape == (2, K, H, 3)
    np.testing.assert_array_equal(found.tried_cost[0], [2, 5, np.nan])
    half = 1.5  # links are 3 apart along each axis, and the last goes on for half of that
    np.testing.assert_allclose(found.tried[1, 0], points[1, :, -1] + half)
    np.testing.assert_allclose(found.planned[0], points[0, :, -1] + 0.5 + half)
    np.testing.assert_allclose(found.planned_tool[0], points[0, :, 0] + 0.5)
    np.testing.assert_allclose(found.planned_joints, 0.25)
    np.testing.assert_allclose(found.terms["reaching"], 0.75 * 1 + 0.25 * 3)


def test_a_record_holds_the_cable_its_goal_and_the_arms(task):
    state = task.settled
    seen = task.simulator.observation(state)
    end = np.asarray(task.end(seen))
    done = Trial(Reaching(state, end + np.array([0.0, 0.2, 0.0])), False, [state, state])
    watched = Watched()
    watched.actions.append(np.zeros(18, np.float32))  # of a command that samples nothing
    record = record_of(task, "straight", 7, done, watched)
    np.testing.assert_allclose(record.goal_way, [end, end], atol=1e-6)
    assert np.linalg.norm(record.goal_way[0] - record.goal) == pytest.approx(0.2, rel=1e-5)
    np.testing.assert_allclose(record.replay["joints"][0], seen.state.joints)
    assert record.replay["actions"].shape == (1, 18) and tried_in(record) is None
    assert (record.method, record.about["scene"], record.reached) == ("straight", 7, False)
    assert record.end == "the limit of 60 commands is met"
    assert not record.obstacles.active.any()  # all boxes are parked


@pytest.mark.slow  # MPPI of the arms is compiled; beside it what is kept of given samples
def test_a_trial_leaves_a_record_that_says_what_was_tried(task, tmp_path, monkeypatch):
    monkeypatch.setattr(arm_control, "LONGEST", 2)
    done = recorded(task, task.drawn(arm_control.SEED, 0), 0, "mppi", tmp_path)
    record = load_record(tmp_path / "mppi" / "00000.npz")
    found = tried_in(record)
    assert found is not None and found.tried.shape == (done.commands, 24, 8, 3)
    assert (np.diff(found.tried_cost, axis=1) >= 0).all()
    assert set(found.terms) == {"reaching", "near", "smoothness", "unstable"}
    # what was planned first comes about, since the plan is rolled out in the simulator that executes it
    assert np.linalg.norm(found.planned[0, 0] - record.goal_way[1]) < 5e-3


def test_only_trials_of_arms_are_recorded_and_nothing_is_written_over(tmp_path):
    with pytest.raises(ValueError, match="trials of arm_reaching alone are recorded: leave it out"):
        mppi("pendulum", record=tmp_path / "new")
    (tmp_path / "notes.txt").write_text("to do")
    with pytest.raises(ValueError, match="is not a new or empty folder: choose another"):
        mppi("arm_reaching", record=tmp_path)
