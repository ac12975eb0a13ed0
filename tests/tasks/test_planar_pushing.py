"""Planar pushing: starts, actions, data, and the same physics on MJX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.actions import sampled
from doojax.datasets import Dataset
from doojax.datasets.collect import collect, random_trajectories
from doojax.datasets.inspect import inspect
from doojax.datasets.replay import replay
from doojax.keys import numbered, stream
from doojax.tasks import make_task
from doojax.tasks.planar_pushing import CYLINDERS, EXTENT, MAX_STEP, RADIUS, SPREAD
from doojax.types import PushingState

TASK = make_task("planar_pushing")
BATCH, PERIODS = 8, 6


@pytest.fixture(scope="module")
def simulated():
    simulator = TASK.simulator("mujoco")
    keys = numbered(stream(0, "test"), range(BATCH))
    return simulator, random_trajectories(TASK, simulator, keys, PERIODS)


def test_starts_are_apart_and_spread(simulated):
    simulator, _ = simulated
    starts = jax.vmap(simulator.reset)(numbered(stream(1, "test"), range(64)))
    places = np.asarray(simulator.observations(starts).state.bodies())[..., :2]
    gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1) + np.eye(CYLINDERS + 1)
    assert gaps.min() > 2 * RADIUS and not np.any(starts.faults)
    assert 0.9 * SPREAD < np.abs(places[:, :-1]).max() <= SPREAD
    assert np.abs(places[:, -1]).max() <= EXTENT.high[0]
    assert np.abs(places.mean((0, 1))).max() < 0.01


def test_the_hand_gets_where_it_is_sent_and_nothing_lies_in_anything(simulated):
    _, (_, _, seen) = simulated
    states: PushingState = seen.states
    assert states.positions.shape == (BATCH, PERIODS + 1, CYLINDERS, 3) and not np.any(seen.faults)
    moved = states.hand[:, 1:] - states.hand[:, :-1]
    np.testing.assert_allclose(moved[..., :2], seen.actions[:, :, 0, :2], atol=5e-4)
    assert 1e-3 < float(jnp.abs(seen.actions).max()) <= MAX_STEP
    places = np.asarray(states.bodies())
    gaps = np.linalg.norm(places[..., :, None, :] - places[..., None, :, :], axis=-1) + np.eye(CYLINDERS + 1)
    assert gaps.min() > 2 * RADIUS - 1e-3
    assert float(jnp.abs(states.velocities[:, -1]).max()) < 5e-3  # quasi-static: at rest after a period


def test_moves_are_kept_and_stay_within_the_extent():
    state = PushingState(
        jnp.zeros((CYLINDERS, 3)), jnp.zeros((CYLINDERS, 3)), jnp.array([0.078, 0.0, RADIUS])
    )
    keys, kept = numbered(stream(2, "test"), range(500)), jnp.array([[-0.004, 0.001, 0.0]])
    draw = jax.jit(jax.vmap(lambda key, before: sampled(TASK.actions, key, state, before), (0, None)))
    again = np.asarray((draw(keys, kept) == kept).all((1, 2))).mean()
    assert 0.97 < again <= 1.0
    fresh = draw(
        numbered(stream(3, "test"), range(500)), jnp.array([[0.004, 0.0, 0.0]])
    )  # which would leave the extent
    assert float((state.hand[0] + fresh[:, 0, 0]).max()) <= EXTENT.high[0] + 1e-6


def test_a_collection_is_a_data_set_of_pushing(tmp_path, capsys):
    collect("planar_pushing", trajectories=12, states=3, engine="mujoco", out=tmp_path / "data")
    data = Dataset.open(tmp_path / "data")
    states = data.states(np.arange(12))
    assert isinstance(states, PushingState) and states.positions.shape == (12, 3, CYLINDERS, 3)
    assert not {"points", "stretch", "clearance", "body_position"} & set(data.fields)
    inspect(tmp_path / "data")
    assert "doojax collect planar_pushing" in capsys.readouterr().out
    replay(tmp_path / "data", trajectory=7)
    assert "bit for bit" in capsys.readouterr().out


@pytest.mark.slow
def test_mjx_does_the_same(simulated):
    _, (start, _, seen) = simulated
    few = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:2], (start, seen.actions))
    _, on_mjx = TASK.simulator("mjx").rollout(*few)
    np.testing.assert_allclose(on_mjx.states.positions, seen.states.positions[:2], atol=1e-4)
    assert not np.any(on_mjx.faults)
