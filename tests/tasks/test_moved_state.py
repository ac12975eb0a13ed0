"""A state that is moved is that state elsewhere: the same rope, with which the simulator does the same."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.geometry.motion import RigidMotion
from doojax.keys import generator
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.tasks import make_task
from doojax.tasks.starts import moved_state, resting, straight_qpos


@pytest.mark.parametrize(
    ("name", "height", "rounding"),
    [("rope_dragging", 0.02, 2e-4), pytest.param("dual_gripper", 1.0, 2e-6, marks=pytest.mark.slow)],
)
def test_physics_do_not_depend_on_where(name, height, rounding):
    """Velocities, commands and actions are turned with the rope, or the periods after would differ.

    A quarter turn, because between those the simulators have axes: the hands' greatest force is that of each
    axis, and friction on a floor has a few directions.
    """
    scene = make_task(name).scene
    starts = resting(scene, np.tile(straight_qpos(scene, height), (2, 1)))
    simulator = MujocoSimulator(scene, start=lambda key: starts)
    draw = generator(0, "moved", name)
    actions = draw.uniform(-0.05, 0.05, (2, 3, len(scene.grippers), 3)) * [1, 1, 0 if scene.planar else 1]
    actions = jnp.asarray(actions, jnp.float32)
    swung, _ = simulator.rollout(starts, actions[:, :2])  # bent, and moving
    swung = jax.tree.map(jnp.asarray, swung)
    assert float(jnp.abs(swung.qvel).max()) > 1e-3

    parameters = jnp.array([0.3, -0.2, 0.0 if scene.planar else 0.1, 0.0, 0.0, jnp.pi / 2])
    motion = RigidMotion.of(parameters, jnp.array([0.1, 0.2, height]))
    move = jax.vmap(lambda state: moved_state(scene, state, motion.about_origin, motion.quaternion))
    _, here = simulator.rollout(swung, actions[:, 2:])
    _, there = simulator.rollout(move(swung), motion.vectors(actions[:, 2:]))
    expected = here.states.moved(motion)
    np.testing.assert_allclose(there.states.points[:, 0], expected.points[:, 0], atol=2e-6)
    np.testing.assert_allclose(there.states.points[:, 1], expected.points[:, 1], atol=rounding)
    np.testing.assert_allclose(there.states.grippers, expected.grippers, atol=rounding)

    if scene.planar:  # whose friction leaves no velocity
        return
    still = replace(move(swung), qvel=swung.qvel)
    _, other = simulator.rollout(still, motion.vectors(actions[:, 2:]))
    assert np.abs(other.states.points[:, 1] - expected.points[:, 1]).max() > 1e-5


def test_a_tilted_rope_is_seen_tilted():
    scene = make_task("dual_gripper").scene
    starts = resting(scene, straight_qpos(scene, 1.0)[None])
    bent = starts.qpos.at[0, 7:-6].set(jnp.asarray(generator(0, "bent").uniform(-0.2, 0.2, 72), jnp.float32))
    starts = replace(starts, qpos=bent)
    simulator = MujocoSimulator(scene, start=lambda key: starts)
    motion = RigidMotion.of(jnp.array([0.3, -0.2, 0.1, 0.4, -0.9, 1.2]), jnp.array([0.1, 0.2, 1.0]))
    tilted = jax.vmap(lambda state: moved_state(scene, state, motion.about_origin, motion.quaternion))(starts)
    seen, before = (simulator.observations(states).state for states in (tilted, starts))
    expected = jax.tree.map(jnp.asarray, before).moved(motion)
    np.testing.assert_allclose(seen.points, expected.points, atol=2e-6)
    np.testing.assert_allclose(seen.grippers, expected.grippers, atol=2e-6)
