"""Ropes and obstacles of one's own: in doojax's tasks, and in one that is made of them alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from doojax.datasets.collect import random_trajectories
from doojax.geometry.sdf import signed_distance
from doojax.simulation.meshes import mesh_obstacle
from doojax.simulation.rope import RopeParameters
from doojax.simulation.scenes import Obstacle, Shape, sphere
from doojax.simulation.state import Fault
from doojax.tasks import (
    Box,
    DualGripper,
    Place,
    RopeDragging,
    Task,
    TwoHands,
    make_task,
    register,
    two_hands_scene,
)
from doojax.types import ShapeKind

BALL = Obstacle("ball", (sphere(0.08),))
PYRAMID = trimesh.convex.convex_hull([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0, 0.1, 0], [0, 0, 0.2]])
HOSE = RopeParameters.of_material(
    length=0.8, radius=0.01, bore=0.007, mass=0.2, youngs_modulus=2e6, bending_damping=1e-3
)


@pytest.fixture(scope="module")
def pyramid():
    return mesh_obstacle("pyramid", PYRAMID, within=0.05)


@pytest.fixture(scope="module")
def hose(pyramid):
    """A hose beside a pyramid that always stands alike, and a ball that stands anywhere."""
    scene = two_hands_scene("own", HOSE, (pyramid, BALL), links=8, timestep=0.01)
    places = (Place((0.0, 0.0, 0.0), yaw=(0.5, 0.5)), Place((0.0, 0.0, 0.3), (0.4, 0.4)))
    reach = Box((-0.4, -0.4, 0.3), (0.4, 0.4, 0.9))
    return TwoHands("own", scene, places, reach, goals=reach, goal_point=4)


@pytest.fixture(scope="module")
def driven(hose):
    """16 random trajectories."""
    simulator = hose.simulator("mujoco")
    return simulator, *random_trajectories(hose, simulator, jax.random.split(jax.random.key(0), 16), 2)


@pytest.mark.parametrize(
    ("task", "ground"), [(RopeDragging(), 0.0), pytest.param(DualGripper(), 0.625, marks=pytest.mark.slow)]
)
def test_other_obstacles_stand_where_the_tasks_own_do(task, ground, pyramid):
    """On the floor or the table, wherever their shapes begin; what the task keeps stays where it was."""
    kept = [one for one in task.scene.obstacles if one.name.startswith(("wall", "table"))]
    changed = replace(task, scene=replace(task.scene, obstacles=(pyramid, *kept, BALL)))
    start = changed.simulator("mujoco").reset(jax.random.key(1))
    assert not start.faults & int(Fault.SCENE_OVERFULL)
    height = np.asarray(start.obstacle_position)[:, 2]
    assert height[0] == pytest.approx(ground, abs=1e-4)
    assert height[-1] == pytest.approx(ground + 0.08, abs=1e-6)
    before = task.simulator("mujoco").reset(jax.random.key(1))
    own = [index for index, one in enumerate(task.scene.obstacles) if one in kept]
    np.testing.assert_array_equal(start.obstacle_position[1:-1], before.obstacle_position[np.array(own)])


def test_more_walls_than_the_arena_has_are_refused():
    task = RopeDragging()
    wall = Obstacle("fifth", (Shape(ShapeKind.BOX, (0.1, 0.1, 0.1), wall=True),))
    changed = replace(task, scene=replace(task.scene, obstacles=(*task.scene.obstacles, wall)))
    with pytest.raises(ValueError, match="obstacle 'fifth' is a wall too many: expected at most 4"):
        changed.start()


@pytest.mark.slow
def test_an_own_task_keeps_a_tasks_promises(hose, driven):
    _, start, _, seen = driven
    assert isinstance(hose, Task) and hash(hose) == hash(replace(hose))
    assert not np.any(seen.faults) and not np.any(start.faults)
    assert float(seen.clearance[:, 0].min()) > 0.005
    assert float(seen.stretch.max()) < 0.03
    assert bool(hose.workspace.contains(seen.states.points).all())
    assert float(jnp.abs(seen.actions).max()) > 0.03


@pytest.mark.slow
def test_what_always_stands_alike_does_and_the_rest_does_not(driven):
    _, start, _, _ = driven
    position = np.asarray(start.obstacle_position)
    assert (position[:, 0] == 0).all()
    assert np.ptp(position[:, 1, :2], axis=0).min() > 0.2
    np.testing.assert_allclose(
        start.obstacle_quaternion[:, 0, [0, 3]], [[np.cos(0.25), np.sin(0.25)]] * 16, rtol=1e-6
    )


@pytest.mark.slow
def test_goals_are_clear_of_own_obstacles(hose, driven):
    simulator, start, _, _ = driven
    obstacles = jax.vmap(simulator.obstacles)(start)
    goals = jax.vmap(hose.sample_goal)(jax.random.split(jax.random.key(1), 16), obstacles)
    assert float(jax.vmap(signed_distance)(obstacles, goals.targets).min()) >= hose.goal_threshold - 1e-6


def test_without_obstacles_there_is_nothing_in_the_way(hose):
    free = replace(hose, scene=replace(hose.scene, obstacles=()), places=())
    start = free.simulator("mujoco").reset(jax.random.key(0))
    assert start.obstacle_position.shape == (0, 3) and not start.faults


def test_an_own_task_is_registered_by_its_factory(hose):
    with register("own", hose.made):
        assert make_task("own", phase="unconstrained") == replace(hose, phase="unconstrained")
        with pytest.raises(
            ValueError, match="own has its own obstacles and no crowd of 2 times as many: give 1"
        ):
            make_task("own", crowd=2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal_point": 8}, "goal_point is 8, expected one of the points 0 to 7"),
        (
            {"places": (Place((0.0, 0.0, 0.0)),)},
            "1 places for the obstacles pyramid, ball: expected one for each",
        ),
        ({"scene": RopeDragging().scene}, "has 1 hands and a planar rope: expected one of two_hands_scene"),
    ],
)
def test_tasks_that_make_no_sense_are_refused(hose, changes, message):
    with pytest.raises(ValueError, match=message):
        replace(hose, **changes)


def test_obstacles_of_one_name_are_refused():
    with pytest.raises(ValueError, match="called ball, ball: expected each name once"):
        two_hands_scene("own", HOSE, (BALL, BALL))
