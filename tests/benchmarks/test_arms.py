"""What MPPI of the arms is priced by, and which joints it moves."""

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.benchmarks import arm_control as bench
from doojax.benchmarks.arms import Bare, rows_of_trials
from doojax.planning.simulated import Tried
from doojax.robots import dual_arm
from doojax.tasks.arm_reaching import HAND, ArmReaching
from doojax.types import ArmsState, Obstacles


def tried(points, joints) -> Tried:
    count = len(points)
    seen = ArmsState(jnp.asarray(points), jnp.zeros((count, 2, 3)), jnp.asarray(joints))
    return Tried(seen, jnp.zeros(count, int), jnp.zeros(count), jnp.zeros(count))


def test_the_end_is_half_a_link_beyond_the_last_centre():
    points = np.zeros((2, 4, 3), np.float32)
    points[:, :, 0] = [0.1, 0.3, 0.5, 0.7]  # so the end is at 0.8
    points[1, :, 1] = 0.5
    found = bench.EndAtGoal(jnp.array([0.8, 0.0, 0.3]))(tried(points, np.zeros((2, 20))), jnp.zeros((2, 16)))
    assert float(found) == pytest.approx(0.3 + np.hypot(0.5, 0.3), rel=1e-5)


@pytest.mark.slow
def test_every_state_in_which_arms_are_near_to_something_costs():
    # at zero elbows are 5 to 10 mm from the torso; shoulders that turn out about y take tools to the side.
    # Fingers end 1.34 cm before the tool's site, which is at 0.5933 m along y when joints are at zero
    robot, joints = dual_arm(), np.zeros((3, 20), np.float32)
    for side, angle in (("left", 0.25), ("right", -0.25)):
        joints[:, robot.joints.index(f"{side}_shoulder_2")] = angle
    tip, states = 0.5933 - 0.0134, tried(np.zeros((3, 4, 3), np.float32), joints)
    for gap, expected in ((0.005, 9.0), (0.015, 0.0)):
        box = Obstacles(
            jnp.zeros(1, int),
            jnp.array([[0.285, tip + gap + 0.1, 0.273]]),
            jnp.array([[1.0, 0, 0, 0]]),
            jnp.full((1, 3), 0.1),
            jnp.ones(1, bool),
        )
        assert float(bench.ArmsNear(robot, box)(states, jnp.zeros((3, 16)))) == expected


@pytest.fixture(scope="module")
def task():
    return ArmReaching()


def test_fingers_stay(task):
    found = np.asarray(bench.JointRollouts(task).whole(jnp.ones((2, 16))))
    names = task.scene.driver.joints
    assert found.shape == (2, 18) and (found.sum(1) == 16).all()
    assert {name for name, value in zip(names, found[0], strict=True) if not value} == {
        "left_finger_1",
        "right_finger_1",
    }


@pytest.mark.slow  # some ten seconds; beside it a tool follows displacements
def test_the_loop_closes_past_a_box(task):
    """With MPPI the cable's end comes to a goal, though a box stands on its straight way."""
    done = bench.trial(task, task.drawn(bench.SEED, 0), 0, bench.METHODS["mppi"])
    away = bench.distances(task, done)
    assert done.reached and away[0] > 0.15 and away[-1] <= 0.05 and done.commands < 30
    assert not any(int(state.faults) & bench.BROKEN for state in done.states)


@pytest.mark.slow
def test_a_tool_follows_displacements_in_a_scene(task):
    """Up and aside by 5 cm in two periods and a third to come to rest, while it holds a cable that swings."""
    drawn = task.drawn(bench.SEED, 0)
    state, obstacles = drawn.state, task.obstacles(drawn.state)
    seen = task.simulator.observation(state)
    targets = seen.hands.at[HAND].add(jnp.array([0.03, 0.0, 0.04]))
    for _ in range(3):
        now = task.simulator.observation(state)
        action = bench.displacing(task, now.state.joints, targets - now.hands, obstacles)
        state = task.simulator.step(state, action)
    after = task.simulator.observation(state)
    assert np.asarray(after.hands[HAND]) == pytest.approx(np.asarray(targets[HAND]), abs=8e-3)
    assert np.abs(np.asarray(after.hands - seen.hands)[1 - HAND]).max() < 0.01  # the other tool stays


@pytest.mark.slow
def test_the_physics_alone_cost_less_than_a_command(task):
    bare = Bare(task, 2)
    state, actions = task.drawn(bench.SEED, 0).state, np.zeros((2, 2, task.scene.layout.driven.size))
    assert bare.seconds(state, actions) > 0
    assert bare.bytes_of_step == 8 * (1 + task.scene.nq + task.scene.layout.nv)


def test_rows_of_trials_compare_the_first_method_with_the_others(task):
    def trials(*reached: bool) -> list[bench.Trial]:
        drawn = task.drawn(bench.SEED, 0)
        return [bench.Trial(drawn, one, [drawn.state] * (4 if one else 61)) for one in reached]

    first, second = trials(*[True] * 10), trials(*[True] * 4, *[False] * 6)
    found = rows_of_trials({"mppi": first, "straight": second})
    rows = {(one.metric, one.tags.get("method")): one for one in found}
    assert rows["success_rate", "mppi"].value == 1 and rows["success_rate", "straight"].value == 0.4
    assert rows["commands_to_goal", "straight"].value == 3 and rows["commands_to_goal", "straight"].n == 4
    # six scenes on which one succeeds and the other fails, all one way: 2 / 2^6
    assert rows["p_value", "mppi"].value == pytest.approx(2 / 64)
    assert rows["p_value", "mppi"].tags["against"] == "straight"
