"""MPPI over a simulator in C: its rollouts are the simulator's, and a hand goes where its cost is least."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.planning import Mppi, MppiSettings, SimulatedRollouts
from doojax.planning.costs import reaching, summed
from doojax.simulation.engines.mujoco import MujocoSimulator
from tests.simulation.scenes import no_start, planar_scene, straight_states

SCENE = planar_scene(substeps=20)  # of 5 ms
SIMULATOR = MujocoSimulator(SCENE, start=no_start)
STATE = jax.tree.map(lambda leaf: leaf[0], straight_states(SCENE, 1))
ROLLOUTS = SimulatedRollouts(SIMULATOR, (1, 3))


def test_rollouts_are_the_simulators_without_their_first_states():
    controls = jax.random.uniform(jax.random.key(0), (3, 4, 3), minval=-0.02, maxval=0.02)
    tried = ROLLOUTS.many(STATE, controls, jnp.zeros(3))
    _, expected = SIMULATOR.rollout(straight_states(SCENE, 3), controls[:, :, None])
    np.testing.assert_array_equal(tried.seen.points, expected.states.points[:, 1:])
    np.testing.assert_array_equal(tried.clearance, expected.clearance[:, 1:])
    assert tried.faults.shape == (3, 4)


def test_from_several_states_every_sample_is_rolled_out_from_each():
    controls = jax.random.uniform(jax.random.key(0), (3, 2, 3), minval=-0.02, maxval=0.02)
    states = straight_states(SCENE, 2)
    states = replace(states, qvel=states.qvel.at[1].add(0.3))
    both = ROLLOUTS.many(states, controls, jnp.zeros(3))
    for number in range(2):
        alone = ROLLOUTS.many(jax.tree.map(lambda leaf, n=number: leaf[n], states), controls, jnp.zeros(3))
        np.testing.assert_array_equal(both.seen.points[:, number], alone.seen.points)
        np.testing.assert_array_equal(both.faults[:, number], alone.faults)
    assert float(jnp.abs(both.seen.points[:, 0] - both.seen.points[:, 1]).max()) > 1e-3


@pytest.mark.slow
def test_the_hand_goes_to_its_goal():
    hand = SIMULATOR.observe(STATE).grippers[0]
    goal = hand + jnp.array([0.05, -0.04, 0.0])
    terms = {"goal": summed(lambda tried, _: reaching(tried.seen.grippers[0], goal))}
    bound = [0.018, 0.018, 1e-6]  # m in a tenth of a second
    settings = MppiSettings(samples=48, horizon=4, temperature=0.003, noise=0.008)
    controller = Mppi(ROLLOUTS, terms, [-b for b in bound], bound, settings)
    nominal, state = controller.start(), STATE
    for key in jax.random.split(jax.random.key(1), 8):
        nominal, report = controller(nominal, state, key)
        report.check()
        state = SIMULATOR.step(state, nominal.controls[0].reshape(1, 3))
        nominal = nominal.advanced()
    begin, end = (
        float(jnp.linalg.norm(place - goal)) for place in (hand, SIMULATOR.observe(state).grippers[0])
    )
    assert begin > 0.06 and end < 0.01
