"""A rope that is fastened to an obstacle, and one that is laid along a polyline."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.simulation.laying import laid
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Attachment, Gripper, Obstacle, Scene, SolverSettings
from doojax.simulation.state import at_rest
from tests.simulation.scenes import no_start

LENGTH, LINKS = 0.6, 6
SCENE = Scene(
    name="fastened",
    rope_model=RopeModel("capsule_chain", LINKS),
    rope=RopeParameters(LENGTH, 0.01, 0.1, bending_stiffness=2e-3, bending_damping=2e-3),
    grippers=(Gripper(link=None, end=0, radius=0.02, max_force=40.0, max_speed=0.2),),
    obstacles=(Obstacle("hook", ()),),
    floor=False,
    timestep=0.004,
    substeps=125,
    viscosity=1.0,
    solver=SolverSettings(cone="pyramidal"),
    attachments=(Attachment("hook", 0, -1),),
)
SIMULATOR = MujocoSimulator(SCENE, start=no_start)
PITCH = LENGTH / LINKS


def ends(state):
    seen = SIMULATOR.observation(state)
    axes = seen.half_links / np.linalg.norm(seen.half_links, axis=-1, keepdims=True)
    first = seen.state.points - axes * PITCH / 2
    return np.concatenate([first, (seen.state.points + axes * PITCH / 2)[-1:]])


def begin(points, hook):
    qpos = np.zeros(SCENE.nq)
    qpos[SCENE.layout.driven] = [[0, 0, 3.0]]
    qpos = jnp.asarray(laid(SCENE, qpos, points), jnp.float32)
    return at_rest(SCENE, qpos, jnp.asarray(hook, jnp.float32)[None], jnp.array([[1.0, 0, 0, 0]]))


def curve(rng):
    """Links of the right length that turn by up to 50 degrees about anything."""
    directions = [np.array([1.0, 0.2, -0.1])]
    for _ in range(LINKS - 1):
        directions.append(directions[-1] + rng.uniform(-0.6, 0.6, 3) * np.linalg.norm(directions[-1]))
    steps = np.array([PITCH * one / np.linalg.norm(one) for one in directions])
    return np.array([0.1, -0.2, 1.0]) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])


def test_links_lie_where_they_were_laid():
    for seed in range(5):
        points = curve(np.random.default_rng(seed))
        np.testing.assert_allclose(ends(begin(points, points[0])), points, atol=2e-6)


def test_a_rope_hangs_from_what_it_is_fastened_to_and_follows_it():
    straight = np.array([0.3, 0.2, 2.0]) + np.arange(LINKS + 1)[:, None] * [PITCH, 0, 0]
    state = begin(straight, straight[0])
    batch = jax.tree.map(lambda leaf: leaf[None], state)
    last, seen = SIMULATOR.rollout(batch, jnp.zeros((1, 20, 1, 3)))
    assert not seen.faults.any()
    rope = ends(jax.tree.map(lambda leaf: leaf[0], last))
    np.testing.assert_allclose(rope[0], straight[0], atol=2e-3)
    np.testing.assert_allclose(rope[-1], straight[0] - [0, 0, LENGTH], atol=0.03)
    moved = replace(last, obstacle_position=last.obstacle_position + jnp.array([0.05, 0, 0]))
    last, _ = SIMULATOR.rollout(moved, jnp.zeros((1, 4, 1, 3)))
    np.testing.assert_allclose(
        ends(jax.tree.map(lambda leaf: leaf[0], last))[0], straight[0] + [0.05, 0, 0], atol=3e-3
    )


def test_what_cannot_be_fastened_or_laid_is_refused():
    with pytest.raises(ValueError, match="fastens link 0 to 'wall', expected one of 6 links"):
        replace(SCENE, attachments=(Attachment("wall", 0, -1),))
    with pytest.raises(ValueError, match="fastens link 6"):
        replace(SCENE, attachments=(Attachment("hook", 6, 1),))
    with pytest.raises(ValueError, match="6 points, expected 7"):
        laid(SCENE, np.zeros(SCENE.nq), np.arange(18.0).reshape(6, 3))


def test_a_scene_with_an_attachment_is_another():
    assert replace(SCENE, attachments=()).digest != SCENE.digest
