"""Tasks as environments: rewards worked by hand, and pure steps equal to batches on any engine."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.environments import action_size, command, features, make_environment, taken
from doojax.environments.base import REACHED, _after
from doojax.goals import goal_of
from doojax.simulation.state import Fault
from doojax.tasks import make_task
from doojax.tasks.base import Box
from doojax.tasks.grippers import GripperMoves

TOY = make_environment("toy")
RESET, STEP = jax.jit(TOY.reset), jax.jit(TOY.step)


def test_rewards_add_up_to_the_way_gained_and_the_goal_ends_an_episode():
    state = first = RESET(jax.random.key(0))
    total = 0.0
    for _ in range(12):
        way = first.goal.targets[0] - TOY.simulator.observe(state.simulation).points[0]
        state = STEP(state, way[:2] / jnp.linalg.norm(way))
        total += float(state.reward)
        if state.done:
            break
    gained = (float(first.missing) - float(state.missing)) / TOY.task.actions.longest
    assert total == pytest.approx(gained + REACHED * float(state.reached), abs=1e-4)
    # the goal where the tail is already: reached by any step that leaves it there
    here = TOY.simulator.observe(first.simulation).points[0]
    begun = eqx.tree_at(
        lambda s: (s.goal, s.missing), first, (goal_of([here], [[0]], 6, 0.05), jnp.zeros(()))
    )
    after = STEP(begun, jnp.zeros(2))
    assert bool(after.done) and bool(after.reached) and float(after.reward) == pytest.approx(REACHED)


def test_an_observation_is_places_clearances_and_the_way_to_the_goal():
    state = RESET(jax.random.key(1))
    seen, goal = TOY.simulator.observe(state.simulation), state.goal
    bodies = seen.bodies()
    count = len(bodies)
    assert state.observation.shape == (TOY.observation_size,) == (4 * count + 3,)
    np.testing.assert_array_equal(state.observation[: 3 * count], bodies.reshape(-1))
    np.testing.assert_allclose(state.observation[-3:], goal.targets[0] - seen.points[0], rtol=1e-6)
    assert float(jnp.linalg.norm(state.observation[-3:])) == pytest.approx(float(state.missing), rel=1e-6)
    free = replace(TOY.simulator.obstacles(state.simulation), active=jnp.array([False]))
    far = features(TOY.task, free, seen, goal)[3 * count : 4 * count]
    np.testing.assert_array_equal(far, np.full(count, 0.5, np.float32))


@pytest.mark.parametrize(("numbers", "length"), [([1, 1], 0.1), ([0, 0.5], 0.05), ([0, -9], 0.1)])
def test_numbers_command_moves_no_longer_than_the_longest(numbers, length):
    action = command(TOY.task.actions, jnp.array(numbers, float))
    assert action.shape == (1, 3) and float(action[0, 2]) == 0.0  # a hand in a plane is not sent upwards
    assert float(jnp.linalg.norm(action)) == pytest.approx(length, rel=1e-6)


def test_hands_in_space_have_three_numbers_each():
    assert action_size(GripperMoves(0.1, Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), grippers=2)) == 6


def test_what_is_invalid_is_not_taken():
    state = RESET(jax.random.key(2))
    seen = TOY.simulator.observe(state.simulation)
    outside = replace(seen, grippers=jnp.array([[5.0, 0.0, 0.0]]))
    action = taken(TOY.task, outside, jnp.array([1.0, 0.0]))
    np.testing.assert_array_equal(action, TOY.task.actions.retreat(outside))


def test_an_unstable_simulation_ends_an_episode_without_nan():
    state = RESET(jax.random.key(3))
    broken = replace(
        state.simulation,
        qpos=jnp.full_like(state.simulation.qpos, jnp.nan),
        faults=jnp.array(int(Fault.NOT_FINITE)),
    )
    after = _after(TOY.task, state, broken, TOY.simulator.observe(broken))
    assert bool(after.done) and not bool(after.reached) and float(after.reward) == 0.0
    assert bool(jnp.isfinite(after.observation).all())


def test_a_batch_steps_as_its_elements_do():
    keys = lambda: jax.random.split(jax.random.key(4), 3)  # noqa: E731
    actions = jax.random.uniform(jax.random.key(5), (3, 2), minval=-1, maxval=1)
    states = TOY.begin(keys())
    together = TOY.advance(states, actions)
    for index in range(3):
        alone = STEP(RESET(keys()[index]), actions[index])
        for name in ("observation", "reward", "missing", "done"):
            np.testing.assert_allclose(getattr(together, name)[index], getattr(alone, name), atol=1e-5)


@pytest.mark.slow
def test_mujoco_c_is_an_environment_of_batches():
    environment = make_environment("rope_dragging", engine="mujoco", phase="unconstrained")
    states = environment.begin(jax.random.split(jax.random.key(6), 3))
    after = environment.advance(states, jnp.full((3, environment.action_size), 0.3))
    assert after.observation.shape == (3, environment.observation_size)
    gained = (states.missing - after.missing) / make_task("rope_dragging").actions.longest
    np.testing.assert_allclose(after.reward, gained + after.reached, atol=1e-5)
    assert float(jnp.abs(after.observation - states.observation).max()) > 0.01
