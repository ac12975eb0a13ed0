"""What every task with a rope promises; pushing has tests of its own."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.actions import ActionSpace, nothing_of, sampled
from doojax.datasets.collect import random_trajectories
from doojax.geometry.sdf import signed_distance
from doojax.tasks import TASKS, make_task, point_goal
from doojax.types import State

BATCH, PERIODS = 8, 4
PHASES = ("unconstrained", "constrained")


TESTED = [
    pytest.param(name, marks=[pytest.mark.slow] * (name == "engine_bay"))  # of the kind of dual_gripper
    for name in sorted(set(TASKS) - {"planar_pushing", "watering", "watering_2d"})
]


@pytest.fixture(scope="module", params=TESTED)
def task(request):
    return make_task(request.param)


@pytest.fixture(scope="module")
def phases(task):
    """What was collected in each phase, made when it is first asked for."""
    made = {}

    def collected(phase):
        if phase not in made:
            own = make_task(task.name, phase=phase)
            simulator = own.simulator("mujoco")
            keys = jax.random.split(jax.random.key(0), BATCH)
            start, _, seen = random_trajectories(own, simulator, keys, PERIODS)
            made[phase] = (simulator, start, seen, phase)
        return made[phase]

    return collected


@pytest.fixture(params=PHASES)
def collected(phases, request):
    return phases(request.param)


@pytest.fixture
def free(phases):
    return phases("unconstrained")


@pytest.fixture
def cluttered(phases):
    return phases("constrained")


@eqx.filter_jit
def aims(task, key, obstacles):
    """A goal in each of a batch of scenes."""
    return jax.vmap(task.sample_goal)(jax.random.split(key, BATCH), obstacles)


@eqx.filter_jit
def surroundings(simulator, starts):
    return jax.vmap(simulator.obstacles)(starts)


@eqx.filter_jit
def chosen(space, key, states, previous):
    """An action in each of a batch of states."""
    keys = jax.random.split(key, len(states.points))
    return jax.vmap(lambda key, state: sampled(space, key, state, previous))(keys, states)


def first(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], tree)


def test_random_trajectories_are_sound(task, collected):
    _, start, seen, phase = collected
    links = task.scene.rope_model.links
    assert seen.states.points.shape == (BATCH, PERIODS + 1, links, 3)
    assert not np.any(seen.faults) and not np.any(start.faults)
    assert np.isfinite(seen.states.points).all()
    assert float(seen.stretch.max()) < 0.03
    if task.name != "toy":  # whose rope follows through walls
        assert float((seen.clearance < -0.002).mean()) <= 0.001
    spacing = np.linalg.norm(np.diff(seen.states.points, axis=2), axis=-1)
    assert spacing.max() < 1.001 * task.scene.rope.length / links
    nothing_there = float(seen.clearance.min()) > 100
    assert nothing_there == (phase == "unconstrained")


def test_unconstrained_grippers_reach_their_targets(free):
    _, _, seen, _ = free
    moved = seen.states.grippers[:, 1:] - seen.states.grippers[:, :-1]
    assert float(jnp.abs(seen.actions).max()) > 0.03  # they are sent somewhere
    assert float(jnp.abs(moved - seen.actions).max()) < 0.005


def test_obstacles_leave_the_rope_room_at_the_start(cluttered):
    _, _, seen, _ = cluttered
    clearance = np.asarray(seen.clearance[:, 0])
    assert clearance.min() > 0.005
    assert clearance.max() < 2.0  # and there are some


def test_goals_are_clear_of_obstacles(task, collected):
    simulator, start, _, _ = collected
    obstacles = surroundings(simulator, start)
    goals = aims(task, jax.random.key(1), obstacles)
    away = jax.jit(jax.vmap(signed_distance))(obstacles, goals.targets)
    assert float(away.min()) >= task.goal_threshold - 1e-6


def test_a_sampled_goal_is_for_the_tasks_own_points(task, collected):
    simulator, start, seen, _ = collected
    goal = first(aims(task, jax.random.key(6), surroundings(simulator, start)))
    state = jax.tree.map(lambda leaf: np.asarray(leaf)[0, -1], seen.states)
    own = {"engine_bay": range(7, 18)}.get(task.name, [task.goal_point])
    missing = min(np.linalg.norm(state.points[point] - goal.targets[0]) for point in own)
    assert float(goal.distance(state)) == pytest.approx(float(missing), rel=1e-6)
    assert float(goal.tolerance) == pytest.approx(task.goal_threshold)


def test_a_state_names_its_passive_bodies_first(task, collected):
    _, _, seen, _ = collected
    state = first(first(seen.states))
    assert isinstance(state, State) and state.passive + task.grippers == len(state.bodies())
    np.testing.assert_array_equal(state.bodies()[: state.passive], state.points)
    np.testing.assert_array_equal(state.bodies()[state.passive :], state.grippers)


def test_the_action_space_keeps_its_promises(task, collected):
    _, _, seen, phase = collected
    space = make_task(task.name, phase=phase).actions
    assert isinstance(space, ActionSpace) and hash(space) == hash(replace(space))
    state, later = (jax.tree.map(lambda leaf, t=t: np.asarray(leaf)[0, t], seen.states) for t in (0, -1))
    drawn = jax.jit(jax.vmap(space.draw))(jax.random.split(jax.random.key(7), 256))
    assert drawn.shape[1:] == nothing_of(space).shape
    assert np.linalg.norm(drawn, axis=-1).max() <= space.longest * (1 + 1e-6)
    # what takes the hands from one state to another in two equal moves misses nothing after both
    half = space.between(state, later, 2)
    np.testing.assert_allclose(state.grippers + 2 * half, later.grippers, atol=1e-6)
    assert float(space.missing(state, 2 * half, later.bodies())) == pytest.approx(0, abs=1e-10)
    assert float(space.missing(state, half, later.bodies())) >= 0


def test_actions_repeat_with_probability_four_fifths(task, collected):
    _, _, seen, phase = collected
    space = make_task(task.name, phase=phase).actions
    states = jax.tree.map(lambda leaf: jnp.asarray(np.repeat(leaf[:1, 0], 2000, axis=0)), seen.states)
    previous = np.full((task.grippers, 3), 1e-4, np.float32) * [1, 1, 0]
    actions = np.asarray(chosen(space, jax.random.key(2), states, jnp.asarray(previous, jnp.float32)))
    repeated = (actions == previous.astype(np.float32)).all((1, 2)).mean()
    assert abs(repeated - 0.8) < 3 * (0.8 * 0.2 / 2000) ** 0.5


def test_unknown_names_are_refused_with_the_list():
    with pytest.raises(ValueError, match="unknown task 'knots', expected one of rope_dragging, dual"):
        make_task("knots")


def test_goals_and_their_point_are_where_the_rope_can_be(task, cluttered):
    simulator, start, seen, _ = cluttered
    every = surroundings(simulator, start)
    goals = [aims(task, jax.random.key(seed), every) for seed in range(8)]
    assert all(bool(task.workspace.contains(one.targets).all()) for one in goals)
    state = first(first(seen.states))
    assert float(point_goal(task, jnp.asarray(state.points[task.goal_point])).distance(state)) == 0.0


def test_sampled_actions_are_valid_and_much_longer_ones_are_not(task, collected):
    _, _, seen, phase = collected
    space = make_task(task.name, phase=phase).actions
    states = jax.tree.map(lambda leaf: jnp.asarray(np.repeat(leaf[:, 0], 2000 // BATCH, axis=0)), seen.states)
    actions = np.asarray(chosen(space, jax.random.key(3), states, jnp.zeros((task.grippers, 3))))
    valid = jax.jit(jax.vmap(space.valid))
    assert bool(valid(states, jnp.asarray(actions)).all())
    long = 0.2 * actions / np.linalg.norm(actions, axis=-1, keepdims=True)
    assert not bool(valid(states, jnp.asarray(long)).any())
