"""Motions of a planar arm around a post: free all the way, within bounds and speeds; and where none is."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.planning.joint_motion import MotionPlanner, MotionSettings, plan_motions, repaired_start
from doojax.robots import clearance, read_robot
from doojax.types import Obstacles

# Two links of 0.5 m that turn about z, and a third joint that never moves. Speeds of 0.5 and 1 rad/s.
ARM = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body><joint name="shoulder" axis="0 0 1" range="-3 3"/>
      <geom type="capsule" size=".02" fromto="0.05 0 0 .45 0 0"/>
      <body pos="0.5 0 0"><joint name="elbow" axis="0 0 1" range="-2.8 2.8"/>
        <geom type="capsule" size=".02" fromto="0.05 0 0 .45 0 0"/>
        <body pos="0.5 0 0"><joint name="wrist" axis="1 0 0" range="-1 1"/><geom size=".03"/>
          <site name="tip"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <intvelocity joint="shoulder" kp="1" ctrlrange="-.5 .5" actrange="-3 3"/>
    <intvelocity joint="elbow" kp="1" ctrlrange="-1 1" actrange="-3 3"/>
  </actuator>
</mujoco>
"""
ROBOT = read_robot(mujoco.MjModel.from_xml_string(ARM), ("tip",))
POST = Obstacles(
    jnp.zeros(1, int),
    jnp.array([[0.8, 0.0, 0.0]]),
    jnp.array([[1.0, 0, 0, 0]]),
    jnp.array([[0.05, 0.05, 0.5]]),
    jnp.ones(1, bool),
)
SETTINGS = MotionSettings(checks=1000, nodes=128, waypoints=48, shortcuts=30, lanes=4)
PLANNER = MotionPlanner(ROBOT, POST, (0, 1), settings=SETTINGS)
KEY = jax.random.key(0)
# beside the post to its other side; nothing in the way; a goal inside the post; one beyond the limits
STARTS = jnp.array([[-0.6, 0.0, 0.3], [0.6, 0.0, 0.0], [0.6, 0.0, 0.0], [0.6, 0.0, 0.0], [0.7, -0.2, 0.1]])
GOALS = jnp.array([[0.6, 0, 0], [1.6, 0.5, 0], [0.0, 0.0, 0], [3.2, 0, 0], [-0.5, -0.4, 0]])


@pytest.fixture(scope="module")
def plans():
    return plan_motions(PLANNER, STARTS, GOALS[:, None], KEY)


@jax.jit
def exact(joints):
    return jax.lax.map(lambda one: clearance(ROBOT, one, POST), joints.reshape(-1, 3), batch_size=64)


@pytest.mark.slow
def test_what_can_be_reached_is_and_what_cannot_is_not(plans):
    assert plans.solved.tolist() == [True, True, False, False, True]
    assert int(plans.checks[2]) >= 1000 > 100 > int(plans.checks[1]) and int(plans.checks[3]) == 0
    for query in (2, 3):
        assert int(plans.count[query]) == 1 and (plans.waypoints[query] == STARTS[query]).all()


@pytest.mark.slow
def test_motions_are_free_and_end_where_they_should(plans):
    for query in (0, 1, 4):
        path = plans.waypoints[query, : int(plans.count[query])]
        assert (path[0] == STARTS[query]).all() and (path[-1, :2] == GOALS[query, :2]).all()
        assert (path[:, 2] == STARTS[query, 2]).all()  # it does not move
    path, fractions = plans.waypoints, jnp.linspace(0, 1, 21)[:, None, None, None]
    between = path[:, :-1] + fractions * (path[:, 1:] - path[:, :-1])
    assert float(exact(between).min()) > 0
    assert ((between >= ROBOT.low) & (between <= ROBOT.high)).all()
    assert int(plans.count[1]) == 2  # a straight line, of which shortcuts leave two waypoints
    straight = STARTS[0] + fractions * (GOALS[0].at[2].set(0.3) - STARTS[0]) + 0 * between
    assert float(exact(straight).min()) < 0 and int(plans.count[0]) > 2  # the post is in the way


@pytest.mark.slow
def test_speeds_are_kept_and_reached(plans):
    times, path = np.asarray(plans.times), np.asarray(plans.waypoints)
    for query in (0, 1, 4):
        count = int(plans.count[query])
        steps, spans = np.diff(path[query], axis=0)[: count - 1], np.diff(times[query])[: count - 1]
        fastest = (np.abs(steps) / [0.5, 1, np.inf] / spans[:, None]).max(1)
        assert fastest == pytest.approx(1, abs=1e-4)
        assert times[query, count:] == pytest.approx(times[query, count - 1])
    one = jax.tree.map(lambda leaf: leaf[1], plans)
    assert float(one.times[1]) == pytest.approx(2.0, abs=1e-5)  # 1 rad at 0.5 rad/s
    assert one.at(jnp.array(1.0)) == pytest.approx(np.array([1.1, 0.25, 0]), abs=1e-5)
    assert one.at(jnp.array(9.0)) == pytest.approx(np.array([1.6, 0.5, 0]), abs=1e-6)


@pytest.mark.slow
def test_a_query_depends_on_its_own_number_alone(plans):
    others = jnp.roll(GOALS, 1, 0).at[0].set(GOALS[0])
    again = plan_motions(PLANNER, STARTS, others[:, None], KEY)
    assert np.array_equal(again.waypoints[0], plans.waypoints[0])


def test_joints_go_no_farther_than_asked():
    planner = replace(PLANNER, settings=replace(SETTINGS, farthest=1.0))
    query = planner.query(STARTS[1], jnp.array([[1.5, 0, 0], [1.7, 0, 0]]))
    assert query.active.tolist() == [True, False]
    assert np.asarray(query.low) == pytest.approx([-0.4, -1.0]) and np.asarray(query.high) == pytest.approx(
        [1.6, 1.0]
    )


@pytest.mark.slow
def test_a_start_in_slight_collision_is_repaired_and_in_deep_collision_refused():
    begin = jnp.array([0.09, 0.0, 0.0])
    assert -0.01 < float(clearance(ROBOT, begin, POST)) < 0.005
    found = repaired_start(PLANNER, begin, KEY)
    assert float(clearance(ROBOT, found, POST)) > SETTINGS.margin
    assert float(jnp.abs(found - begin).max()) < 10 * np.deg2rad(2) and float(found[2]) == 0
    free = STARTS[0]
    assert (repaired_start(PLANNER, free, KEY) == free).all()
    with pytest.raises(
        ValueError, match=r"no start is free within 2 rounds of 1 degrees: the best is -0\.0\d+ m"
    ):
        repaired_start(PLANNER, jnp.zeros(3), KEY, most=float(np.deg2rad(1)), rounds=2)


def test_bad_queries_are_told():
    def check(start, goals):
        PLANNER.check(jnp.asarray(start), jnp.asarray(goals))

    check(STARTS[0], GOALS[:1])
    with pytest.raises(ValueError, match=r"joint 'elbow' starts at 2\.9, beyond its limits, -2\.8 to 2\.8"):
        check([0.6, 2.9, 0.0], GOALS[:1])
    with pytest.raises(ValueError, match=r"the start is -0\.07 m from what it must not touch, expected more"):
        check([0.0, 0.0, 0.0], GOALS[:1])
    with pytest.raises(ValueError, match="none of 1 goals is within the joints' limits and 280 degrees"):
        check(STARTS[0], [[3.2, 0.0, 0.0]])
    with pytest.raises(ValueError, match=r"no goal is farther than 0\.005 m .* the best is -0\.07 m"):
        check(STARTS[0], [[0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="checks is 0, expected more than 0"):
        MotionSettings(checks=0)
    with pytest.raises(ValueError, match=r"longest is 2\.0 rad, expected at most 512 times step, 0\.003 rad"):
        MotionSettings(step=0.003)
    with pytest.raises(ValueError, match="nodes is 1, expected 2 or more"):
        MotionSettings(nodes=1)
