"""The faces for gymnasium and brax."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from doojax.environments import make_environment
from doojax.environments.gymnasium_env import SingleEnvironment, VectorEnvironment

TOY = make_environment("toy")


def test_gymnasiums_own_check_passes():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of infinite bounds, which places have
        check_env(SingleEnvironment(TOY, steps=3), skip_render_check=True)


@pytest.mark.slow
def test_a_vector_of_episodes_ends_and_begins_anew_as_gymnasium_says():
    """Truncated after two steps; the next step's action is not taken, its reward is none."""
    many = VectorEnvironment(TOY, 3, steps=2)
    with pytest.raises(ResetNeeded):
        many.step(np.zeros((3, 2)))
    first, info = many.reset(seed=4)
    assert first.shape == (3, TOY.observation_size) and not info["reached"].any()
    actions = np.full((3, 2), 0.5, np.float32)
    many.step(actions)
    last, _, terminated, truncated, _ = many.step(actions)
    assert (truncated ^ terminated).all()
    anew, rewards, terminated, truncated, _ = many.step(actions)
    assert (rewards == 0).all() and not terminated.any() and not truncated.any()
    assert (np.abs(anew - last).max(1) > 0.01).all() and (np.abs(anew - first).max(1) > 0.01).all()
    again, _ = many.reset(seed=4)
    np.testing.assert_array_equal(again, first)
    fewer, _ = VectorEnvironment(TOY, 2, steps=2).reset(seed=4)
    np.testing.assert_array_equal(fewer, first[:2])
    with pytest.raises(ValueError, match="count is 0"):
        VectorEnvironment(TOY, 0)


def test_brax_sees_the_same_steps_and_ends_episodes():
    pytest.importorskip("brax")
    from brax.envs.wrappers.training import wrap

    from doojax.environments.brax_env import BraxEnvironment

    face = BraxEnvironment(TOY)
    wrapped = wrap(face, episode_length=2)
    keys = lambda: jax.random.split(jax.random.key(0), 3)  # noqa: E731
    state = jax.jit(wrapped.reset)(jax.random.key_data(keys()))  # as brax makes them
    np.testing.assert_allclose(state.obs, TOY.begin(keys()).observation, atol=1e-6)
    step = jax.jit(wrapped.step)
    actions = jnp.full((3, 2), 0.2)
    one = step(state, actions)
    np.testing.assert_allclose(one.reward, TOY.advance(TOY.begin(keys()), actions).reward, atol=1e-5)
    two = step(one, actions)
    assert (two.done == 1).all()
    np.testing.assert_array_equal(two.obs, state.obs)  # begun anew
    new = face.reset(keys()[0])  # a key as all else in doojax
    np.testing.assert_allclose(new.obs, state.obs[0], atol=1e-6)
    with pytest.raises(ValueError, match="brax needs an engine that runs inside of jit"):
        BraxEnvironment(make_environment("rope_dragging", engine="mujoco"))
