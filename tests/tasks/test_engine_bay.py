"""The engine bay: boxes where the released code has them, goals that can be reached under tabs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.geometry.sdf import signed_distance
from doojax.simulation.scenes import obstacles_at
from doojax.tasks import EngineBay, make_task
from doojax.tasks.engine_bay import GOALS, HELD, LIFTED, TARGET_ROPE, bay_poses
from doojax.tasks.ropes import carrying, with_rope

TABS = [(1.151, -0.262, 0.279), (0.901, -0.271, 0.275), (1.139, 0.102, 0.279), (0.849, 0.093, 0.254)]
BODY, TOP, HOOD = (1.017, -0.117, 0.237), (0.924, -0.130, 0.415), (1.511, -0.13, 0.605)
PALLET_TOP = 0.123  # m


@pytest.fixture(scope="module")
def fixed():
    """The task with the rope held in front of the engine, on MuJoCo C, and its start."""
    task = EngineBay(starts="fixed")
    simulator = task.simulator("mujoco")
    starts = [simulator.reset(jax.random.key(seed)) for seed in (1, 2)]
    return task, simulator, jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)


@pytest.fixture(scope="module")
def bay():
    return obstacles_at(EngineBay().scene, *bay_poses())


def test_boxes_stand_where_the_released_code_has_them(bay):
    """World positions as they were found from the released code's model and its pose, to a millimetre."""
    centres = np.asarray(bay.centre)
    for place in (BODY, TOP, HOOD, *TABS):
        assert np.linalg.norm(centres - np.array(place), axis=-1).min() < 1e-3
    assert len(centres) == 21 and bool(bay.active.all())


def test_the_hood_leans_over_the_engine(bay):
    """By 0.55 + 0.017 rad, its upper edge towards the robot, which stands at x = 0."""
    hood = np.linalg.norm(np.asarray(bay.centre) - np.array(HOOD), axis=-1).argmin()
    w, x, y, z = np.asarray(bay.quaternion[hood], float)
    up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    assert np.degrees(np.arccos(up[2])) == pytest.approx(np.degrees(0.55 + 0.017), abs=0.1)
    assert up[0] < -0.5


def test_goals_lie_between_pallet_and_tabs(bay):
    """Each a few centimetres beside or under a tab, below it and above the pallet, with room for the rope."""
    clear = np.asarray(signed_distance(bay, jnp.array(GOALS)))
    assert (clear > 0.03).all() and clear.max() < 0.06
    for x, y, z in GOALS:
        assert PALLET_TOP + 0.01 < z < min(tab[2] for tab in TABS) - 0.05
        assert min(np.hypot(x - tab[0], y - tab[1]) for tab in TABS) < 0.1


def test_any_point_of_the_ropes_middle_reaches_a_goal(fixed, bay):
    task, simulator, start = fixed
    state = jax.tree.map(lambda leaf: leaf[0], simulator.observations(start).state)
    goal = task.sample_goal(jax.random.key(3), bay)
    assert any(np.allclose(goal.targets[0], place, atol=1e-6) for place in GOALS)
    assert float(goal.tolerance) == pytest.approx(0.045)
    for point in range(25):
        there = state.points.at[point].set(goal.targets[0])
        moved = type(state)(there, state.grippers)
        assert (float(goal.distance(moved)) == 0.0) == (7 <= point <= 17)


def test_the_fixed_start_is_one_and_hangs_in_front_of_the_engine(fixed, bay):
    _, simulator, start = fixed
    assert np.array_equal(start.qpos[0], start.qpos[1]) and not np.asarray(start.faults).any()
    state = jax.tree.map(lambda leaf: leaf[0], simulator.observations(start).state)
    for hand, side in zip(np.asarray(state.grippers), (0.2, -0.2), strict=True):
        assert hand == pytest.approx([0.8, side, 0.9 + LIFTED], abs=2e-3)
    # 0.8 m of rope between hands 0.4 m apart: a catenary, a sinh(0.2 / a) = 0.4, sags by 0.319 m
    lowest = np.asarray(state.points)[12]
    assert lowest == pytest.approx([0.8, 0.0, HELD[2] - 0.319], abs=0.02)
    assert float(signed_distance(bay, state.bodies()).min()) > 0.1


def test_the_engine_carries_the_rope(fixed):
    """Lowered onto it by half a metre, the rope's middle stays above, its hands beside and below."""
    _, simulator, start = fixed
    over = jnp.tile(jnp.array([[0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]), (2, 1, 1, 1))
    apart = jnp.tile(jnp.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]), (2, 1, 1, 1))
    down = jnp.tile(jnp.array([[0.0, 0.0, -0.1], [0.0, 0.0, -0.1]]), (2, 4, 1, 1))
    _, seen = simulator.rollout(start, jnp.concatenate([over, apart, down], axis=1))
    assert not np.asarray(seen.faults).any()
    last = np.asarray(seen.states.points[0, -1])
    hands = np.asarray(seen.states.grippers[0, -1])
    top = 0.415 + 0.065  # of the engine
    assert last[12, 2] > top and hands[:, 2].max() < HELD[2] - 0.35
    assert float(seen.clearance.min()) > -0.004


def test_the_target_rope_is_carried_by_states_of_the_same_scene(fixed):
    """Chapter IV's: springs in its joints, so that it sags by less between the same hands."""
    task, simulator, start = fixed
    stiff = carrying(task, start, TARGET_ROPE)
    still = jnp.zeros((2, 6, 2, 3))
    _, own = simulator.rollout(start, still)
    _, other = simulator.rollout(stiff, still)
    assert not np.asarray(other.faults).any()
    gap = float(other.states.points[0, -1, 12, 2] - own.states.points[0, -1, 12, 2])
    assert gap > 0.01
    assert with_rope(task, TARGET_ROPE).scene.rope.bending_stiffness == 0.032


def test_there_is_one_engine():
    assert make_task("engine_bay").name == "engine_bay"
    with pytest.raises(ValueError, match="crowd is 2, but engine_bay has one engine, expected 1"):
        make_task("engine_bay", crowd=2)
