"""Watering in the plane: starts, pours, what is cancelled, data, goals; and that a search finds a pour."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.actions import nothing_of, sampled
from doojax.datasets import Dataset
from doojax.datasets.collect import collect
from doojax.datasets.inspect import inspect
from doojax.geometry.motion import RigidMotion
from doojax.keys import numbered, stream
from doojax.planning import simulated_start
from doojax.simulation.fluid.containers import Container
from doojax.simulation.fluid.pouring import split
from doojax.simulation.scenes import PARKED_POSITION
from doojax.tasks import Task, make_task
from doojax.tasks.watering import (
    CANOPY,
    NARROW,
    RECEIVER_PLACE,
    STEM,
    WORKSPACE,
    default_scene,
)
from doojax.types import Obstacles, PouringState, State

COARSE = replace(
    default_scene("constrained", 2).fluid, spacing=0.015, time_step=0.004, iterations=2, viscosity=1e-3
)


MOVES = [
    [[0.18, 0.0, 0.0], [0.14, 0.10, 0.0], [0.0, 0.0, 2.4], [0.0, 0.0, 2.4]],  # over the receiver, tilted
    [[0.18, -0.1, 0.0], [0.30, -0.20, 0.0], [0.0, 0.6, 0.0], [0.0, 0.0, 0.0]],  # into it, into the canopy
]


@pytest.fixture(scope="module")
def task():
    """Two dozen particles, and periods of half the length."""
    made: Any = make_task("watering_2d")
    return replace(made, scene=replace(made.scene, fluid=COARSE, particles=24, looks=40, ramp=20, fall=0.6))


@pytest.fixture(scope="module")
def moved(task):
    """Two side by side: one without a plant that pours, and one that is sent where it cannot go."""
    simulator = task.simulator()
    start = jax.vmap(simulator.reset)(numbered(stream(0, "test"), range(2)))
    bare = start.obstacle_position.at[0, 1].set(jnp.array(PARKED_POSITION))
    start = replace(start, obstacle_position=bare)
    return simulator, start, *simulator.rollout(start, jnp.array(MOVES)[:, :, None])


@pytest.fixture
def poured(moved):
    """The first of the two."""
    return jax.tree.map(lambda leaf: leaf[0], moved[1:])


def test_it_is_a_task_whose_states_are_of_its_kind(task, moved, poured):
    start, _, seen = poured
    assert isinstance(task, Task)
    state = moved[0].observe(start)
    assert isinstance(state, State) and state.bodies().shape == (7, 3)
    assert jax.tree.structure(state) == jax.tree.structure(task.blank)
    assert [leaf.shape for leaf in jax.tree.leaves(state)] == [
        leaf.shape for leaf in jax.tree.leaves(task.blank)
    ]
    assert nothing_of(task.actions).shape == (1, 3) and not np.any(seen.faults)


def test_the_container_gets_where_it_is_sent_and_pours(poured):
    *_, seen = poured
    place = np.asarray(seen.states.container)
    moved = place - place[0]
    np.testing.assert_allclose(moved[1, ::2], [0.18, 0.0], atol=2e-3)
    np.testing.assert_allclose(moved[2:, ::2], np.tile([0.32, 0.10], (3, 1)), atol=2e-3)
    np.testing.assert_allclose(seen.states.angle, [0, 0, 0, 2.4, 2.4], atol=0.01)
    volumes = np.asarray(seen.states.volumes)
    assert volumes[2, 1] > 0.95 and volumes[2, 0] == 0  # carried, nothing is spilled
    assert volumes[4, 0] > 0.7 and volumes[4, 1] < 0.1


def test_a_simulation_that_is_planned_with_answers_for_what_is_seen_of_it(task, moved):
    simulator, start, *_ = moved
    begun = jax.tree.map(lambda leaf: leaf[0], simulated_start(simulator, start))
    np.testing.assert_array_equal(begun.container, simulator.observe(begun.simulation).container)
    assert not bool(task.actions.valid(begun, jnp.array([[0.0, 0.0, 2.5]])))  # too far from the receiver
    assert isinstance(begun, PouringState) and begun.passive == 3


def test_no_fluid_is_lost_or_in_a_wall(task, poured):
    _, last, seen = poured
    positions, _ = split(task.scene, last.qpos)
    assert positions.shape == (24, 2) and np.isfinite(positions).all()
    assert float(positions[:, 1].min()) > task.scene.fluid.radius - 1e-3  # on the floor, at the lowest
    assert float(seen.states.volumes.sum(-1).max()) <= 1 + 1e-6


def test_a_move_into_the_receiver_or_the_plant_is_cancelled(moved):
    *_, seen = moved
    place = np.asarray(seen.states.container[1])
    sent = place[1, 2] - 0.20
    assert place[2, 2] > sent + 0.05  # the receiver's rim stopped it
    assert place[3, 2] + NARROW.height < CANOPY[0][2] + 1e-3  # the canopy did, on its way up
    assert float(seen.clearance.min()) >= 0


def test_what_was_held_up_does_not_jump_when_it_gets_free(task):
    """Under the canopy it cannot be tilted: what is missing in angle grows, and must not take it through."""
    simulator = task.simulator()
    held = jnp.array([0.13, 0.32, 0.9])
    far = jnp.array([0.43, 0.62, 3.0])
    moved = np.asarray(simulator._limited(far - held))
    np.testing.assert_allclose(moved, [0.03 / 2**0.5, 0.03 / 2**0.5, 0.1], rtol=1e-5)
    np.testing.assert_allclose(simulator._limited(jnp.array([0.01, -0.01, 0.05])), [0.01, -0.01, 0.05])


def test_the_gap_is_that_of_boxes_side_by_side(task):
    simulator = task.simulator()
    obstacles = simulator.obstacles(simulator.reset(stream(2, "test")))
    width = NARROW.width / 2 + NARROW.wall
    beside = jnp.array([STEM[0][0] - width - 0.03, 0.22, 0.0])
    assert float(simulator.gap(obstacles, beside)) == pytest.approx(0.03, abs=1e-5)
    on_top = jnp.array([CANOPY[0][0] + 0.1, CANOPY[1][2] + NARROW.wall + 0.04, 0.0])
    assert float(simulator.gap(obstacles, on_top)) == pytest.approx(0.04, abs=1e-5)
    assert float(simulator.gap(obstacles, jnp.array([0.3, 0.6, 0.5]))) < 0
    upside_down = jnp.array([-0.3, 0.2, jnp.pi])
    assert float(simulator.gap(obstacles, upside_down)) == pytest.approx(0.2 - NARROW.height, abs=1e-5)


NOTHING = Obstacles(
    jnp.zeros(0, int), jnp.zeros((0, 3)), jnp.zeros((0, 4)), jnp.zeros((0, 3)), jnp.zeros(0, bool)
)


def state_at(x, z, angle=0.0, volumes=(0.0, 1.0)):
    size = jnp.array([0.141, 0.13])
    return PouringState(
        jnp.array([x, 0.0, z]), jnp.array(angle), jnp.array(RECEIVER_PLACE), jnp.array(volumes), size
    )


def test_gauges_stand_for_volumes():
    seen = state_at(0.1, 0.3, volumes=(0.5, 0.4))
    gauges = np.asarray(seen.bodies())[:2, 2] - RECEIVER_PLACE[2]
    np.testing.assert_allclose(gauges, [0.25, 0.125], atol=1e-6)  # half a metre each whole; 10 % spilled
    assert seen.passive == 3


@pytest.mark.parametrize(
    ("volumes", "reached"),
    [
        ((0.76, 0.24), True),
        ((0.74, 0.26), False),
        ((0.96, 0.0), True),
        ((0.94, 0.0), False),
        ((1.0, 0.0), True),
    ],
)
def test_the_goal_is_three_quarters_poured_and_a_twentieth_spilled(volumes, reached):
    task: Any = make_task("watering_2d")
    goal = task.sample_goal(stream(0, "goal"), NOTHING)
    assert bool(goal.distance(state_at(0.2, 0.3, volumes=volumes)) <= goal.tolerance) == reached


def test_a_moved_state_has_moved_bodies():
    motion = RigidMotion.of(jnp.array([0.3, -0.2, 0.1, 0.0, 0.0, 0.0]), jnp.zeros(3))
    seen = state_at(0.1, 0.4, 0.5)
    np.testing.assert_allclose(seen.moved(motion).bodies(), motion.points(seen.bodies()), atol=1e-6)


def test_actions_are_of_three_kinds_and_valid_where_they_are_drawn():
    space = make_task("watering_2d").actions
    keys, others = (numbered(stream(seed, "actions"), range(400)) for seed in (0, 1))
    draw = jax.jit(jax.vmap(lambda key, state: sampled(space, key, state, jnp.zeros((1, 3))), (0, None)))
    near, far = state_at(0.25, 0.3), state_at(-0.05, 0.3)
    here, there = np.asarray(draw(keys, near))[:, 0], np.asarray(draw(others, far))[:, 0]
    tilts = here[:, 2] > 1.0
    assert 0.6 < tilts.mean() < 0.85 and not (there[:, 2] > 1.0).any()
    assert np.abs(here[tilts, :2]).max() == 0
    edge = RECEIVER_PLACE[0] - 0.351 / 2 - 0.02
    over = np.abs(there[:, 0] - 0.05 - edge) < 0.1
    assert over.mean() > 0.5
    valid = jax.vmap(space.valid, (None, 0))
    assert bool(valid(far, jnp.asarray(there)[:, None]).all())
    assert bool(valid(near, jnp.asarray(here)[:, None]).all())
    assert not bool(space.valid(far, jnp.array([[0.0, 0.0, 2.5]])))  # beside the receiver nothing is poured
    assert not bool(space.valid(near, jnp.array([[0.01, 0.0, 0.0]])))  # too short
    assert not bool(space.valid(near, jnp.array([[2.0, 0.0, 0.0]])))


def test_what_is_straight_between_two_states_misses_nothing():
    space = make_task("watering_2d").actions
    before, after = state_at(0.0, 0.3), state_at(0.24, 0.2)
    half = space.between(before, after, 2)
    assert half.shape == (1, 3)
    assert float(space.missing(before, half.at[0, :2].multiply(2), after.bodies())) < 1e-10
    assert float(space.missing(before, half, after.bodies())) > 1e-3


def test_samples_are_states_that_could_be():
    task: Any = make_task("watering_2d")
    goal = task.sample_goal(stream(0, "goal"), NOTHING)
    shape = state_at(0.0, 0.3).bodies()
    draw = jax.vmap(lambda key, to: task.sample(key, task.workspace, shape, goal, to), (0, None))
    keys, others = (numbered(stream(seed, "samples"), range(64)) for seed in (0, 1))
    somewhere, there = draw(keys, jnp.array(False)), draw(others, jnp.array(True))
    assert bool(WORKSPACE.contains(somewhere[:, 2]).all())
    np.testing.assert_allclose(there[:, :2], jnp.broadcast_to(goal.targets, (64, 2, 3)))
    edges = np.linalg.norm(np.asarray(somewhere[:, 4] - somewhere[:, 3]), axis=-1)
    np.testing.assert_allclose(edges, 0.141, atol=1e-5)


def test_what_cannot_be_simulated_is_refused():
    scene = default_scene("constrained", 2)
    with pytest.raises(ValueError, match="do not fit into a container"):
        replace(scene, particles=10_000)
    with pytest.raises(ValueError, match="it would be empty"):
        replace(scene, particles=0)
    with pytest.raises(ValueError, match="smaller than a particle"):
        replace(scene, container=Container(0.005, 0.1, 0.1))
    with pytest.raises(ValueError, match="could pass through a wall"):
        replace(scene, fluid=replace(scene.fluid, time_step=0.01, viscosity=1e-5))
    with pytest.raises(ValueError, match=r"time step is 0\.003 s, expected a whole part of 0\.02 s"):
        replace(scene, fluid=replace(scene.fluid, time_step=0.003, viscosity=1e-5))
    with pytest.raises(ValueError, match="crowd is 2, but watering has one receiver"):
        make_task("watering", crowd=2)


@pytest.mark.slow
def test_a_collection_is_a_data_set_of_pours(tmp_path, capsys):
    collect("watering_2d", trajectories=4, states=3, out=tmp_path / "data")
    data = Dataset.open(tmp_path / "data")
    states = data.states(np.arange(4))
    assert isinstance(states, PouringState) and states.volumes.shape == (4, 3, 2)
    assert "stretch" not in data.fields and "clearance" in data.fields
    inspect(tmp_path / "data")
    assert "doojax collect watering_2d" in capsys.readouterr().out
