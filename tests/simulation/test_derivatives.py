"""Derivatives through MJX in free motion: reverse mode needs a solver with one iteration."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from doojax.simulation.engines import make_simulator
from doojax.simulation.scenes import SolverSettings
from tests.simulation.scenes import no_start, planar_scene, straight_states

STEP = 1e-5


def reached(simulator, state, action):
    """Where the gripper and the tail are after one period of 20 physics steps, m."""
    after = simulator.observe(simulator.step(state, action))
    return jnp.concatenate([after.grippers[0, :2], after.points[0, :2]])


def test_forward_and_reverse_mode_agree_with_finite_differences_in_free_motion():
    with jax.enable_x64(True):
        scene = replace(
            planar_scene(substeps=20), solver=SolverSettings(iterations=1, line_search_iterations=10)
        )
        simulator = make_simulator(scene, start=no_start, engine="mjx")
        state = jax.tree.map(lambda leaf: leaf[0], straight_states(scene, 1))
        state = jax.tree.map(lambda x: x.astype(float) if x.dtype == jnp.float32 else x, state)
        action, direction = jnp.array([[0.01, 0.004, 0.0]]), jnp.array([[0.6, 0.8, 0.0]])
        run = jax.jit(lambda a: reached(simulator, state, a))
        _, forward = jax.jvp(run, (action,), (direction,))
        reverse = jax.jit(jax.jacrev(lambda a: reached(simulator, state, a)))(action)
        slope = (run(action + STEP * direction) - run(action - STEP * direction)) / (2 * STEP)
        assert jnp.abs(forward - slope).max() < 1e-3 * jnp.abs(slope).max()
        assert jnp.abs((reverse * direction).sum((1, 2)) - forward).max() < 1e-6
