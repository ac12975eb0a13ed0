"""Scenes of reaching: everything is free at the start, and a scene is the same whenever it is drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.geometry.sdf import signed_distance
from doojax.robots import clearance, obstacle_distances
from doojax.simulation.grasps import grasp_places
from doojax.simulation.scenes import obstacles_at
from doojax.tasks.arm_reaching import FREE, HAND, HELD, RADIUS, ArmReaching
from doojax.tasks.arms import BASE, rope_ends


@pytest.fixture(scope="module")
def task():
    return ArmReaching()


@pytest.fixture(scope="module")
def scenes(task):
    return [task.drawn(0, number) for number in range(4)]


def test_the_cable_hangs_from_the_tool_that_holds_it(task):
    seen = task.simulator.observation(task.settled)
    held = np.asarray(grasp_places(task.scene, task.settled))
    assert np.isnan(held[0]) and held[HAND] == pytest.approx(HELD)
    ends = np.asarray(rope_ends(task.scene, seen) - seen.hands[HAND])
    assert np.linalg.norm(ends[-1]) <= 0.3 + 3e-3 and np.linalg.norm(ends[0]) <= 0.7 + 3e-3
    # stiffness over weight bends it over (0.004 N m^2 / 3.5 N/m)^(1/3), some 10 cm, and so it falls short
    assert -0.3 < ends[-1, 2] < -0.15 and -0.7 < ends[0, 2] < -0.5
    assert np.abs(task.settled.qvel).max() < 0.05  # it is at rest


def test_the_arms_are_near_to_nothing_at_the_start(task):
    joints = task.simulator.observation(task.settled).state.joints
    assert float(clearance(task.robot, joints, task.robot.base, -BASE[2])) > 0.015


@pytest.mark.slow
def test_everything_is_free_at_the_start_and_goals_are_elsewhere(task, scenes):
    seen = task.simulator.observation(task.settled)
    rope = rope_ends(task.scene, seen)
    free = jax.jit(lambda joints, obstacles: obstacle_distances(task.robot, joints, obstacles).min())
    goals = np.array([one.goal for one in scenes])
    assert len(np.unique(goals.round(3), axis=0)) == len(scenes)
    for one in scenes:
        assert not task.reached(one.state, one.goal)
        straight = rope[-1] + jnp.linspace(0, 1, 200)[:, None] * (one.goal - rope[-1])
        assert float(free(seen.state.joints, task.obstacles(one.state))) > FREE
        boxes = obstacles_at(task.scene, one.state.obstacle_position, one.state.obstacle_quaternion)
        assert float(signed_distance(boxes, straight).min()) < 5e-3  # a box is in the way
        assert float(signed_distance(boxes, rope).min()) > FREE + RADIUS
        assert float(signed_distance(boxes, jnp.asarray(one.goal))) > FREE + RADIUS and one.goal[2] > FREE
        assert task.reached(one.state, np.asarray(rope[-1]) + np.array([0.02, 0.03, 0.0]))


@pytest.mark.slow
def test_a_scene_is_its_seeds_and_its_numbers(task, scenes):
    again = task.drawn(0, 2)
    np.testing.assert_array_equal(again.goal, scenes[2].goal)
    np.testing.assert_array_equal(again.state.obstacle_position, scenes[2].state.obstacle_position)
    assert np.abs(task.drawn(1, 2).goal - again.goal).max() > 1e-3
