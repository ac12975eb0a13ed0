"""Trials of arms: execution that is repeated, and (slow) a closed loop that reaches its goal."""

import numpy as np
import pytest

from doojax.experiments.regrasping.figures import rows_of
from doojax.experiments.regrasping.run import RegraspSettings
from doojax.experiments.regrasping.trial import run_trial
from doojax.experiments.regrasping.world import Executed, World, as_jax, repeated
from doojax.experiments.trials.record_files import load_record, save_record
from doojax.simulation.grasps import grasped
from doojax.tasks.arms import BASE
from tests.experiments.regrasping import scenes


@pytest.fixture(scope="module")
def simulator():
    return scenes.TASK.simulator()


@pytest.fixture(scope="module")
def world(simulator):
    return World(scenes.TASK, simulator, scenes.start())


def test_an_execution_is_repeated_from_its_actions_and_grasps(world):
    begin = scenes.start().state
    execution = Executed(world, begin)
    turned = execution.joints[0].copy()
    turned[world.robot.joints.index("left_shoulder_1")] -= 0.1
    assert execution.follow(np.stack([execution.joints[0], turned]))
    arrived = np.asarray(execution.joints[-1])[np.array(world.task.moving)]
    np.testing.assert_allclose(arrived, turned[np.array(world.task.moving)], atol=0.03)
    execution.state = grasped(world.scene, as_jax(execution.state), 0, 0.8)
    execution.act(np.zeros(18), 3)
    execution.release(0)
    execution.act(np.zeros(18), 2)
    held = np.array(execution.held)
    assert np.isnan(held[-2:]).all() and np.allclose(held[-5:-2, 0], 0.8)
    again = repeated(world, begin, execution.actions, execution.held)
    np.testing.assert_allclose(again, np.stack(execution.ropes), atol=1e-5)


def test_a_hand_far_from_the_rope_grasps_nothing(world):
    execution = Executed(world, scenes.start().state)
    gap = execution.grasp(0, 0.5)
    tool = np.asarray(execution.hands[0][0])
    middle = np.array(scenes.HOOK) - [0, 0, scenes.LENGTH / 2]
    assert gap == pytest.approx(np.linalg.norm(tool - middle), abs=2e-3) and gap > 0.05
    assert np.isnan(world.places(execution.state)).all()
    np.testing.assert_allclose(world.fastened, np.array(scenes.HOOK) - BASE, atol=1e-6)


@pytest.mark.slow
def test_a_trial_reaches_its_goal_and_its_record_says_how(simulator, world, tmp_path):
    settings = RegraspSettings(iterations=40)
    trial = run_trial(scenes.TASK, simulator, scenes.start(), "signature", 0, 0, settings)
    record = trial.record
    assert record.reached and record.end == "the goal is reached"
    regrasps = record.about["regrasps"]
    assert regrasps[0]["changed"] and len(regrasps[0]["candidates"]) == 2 * 20
    chosen = regrasps[0]["candidates"][regrasps[0]["chosen"]]
    assert chosen["cost"] == min(one["cost"] for one in regrasps[0]["candidates"])
    # the executed world is the simulated one, but that the arm came on a way and was not put there
    assert regrasps[0]["rope_off_mean"] < 0.02
    assert regrasps[0]["planned_signature"] == regrasps[0]["executed_signature"]
    save_record(tmp_path / "trial.npz", record)
    again = load_record(tmp_path / "trial.npz")
    held = again.replay["held"]  # pyright: ignore
    rope = repeated(world, scenes.start().state, again.replay["actions"], held)  # pyright: ignore
    np.testing.assert_allclose(rope, record.points, atol=1e-4)
    rows = {one.metric: one.value for one in rows_of("hanging", {"signature": [trial]})}
    assert rows["success_rate"] == 1 and rows["wall_min"] > 0
