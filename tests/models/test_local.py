"""Local frames: in and out again, and what they do not see."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.geometry.frames import quaternion_from_yaw, rotate
from doojax.models.local import flat, local_frame, unflat
from doojax.types import RopeState

ORIGINS, SYMMETRIES = ("gripper", "centroid"), ("translation", "canonical")


def drawn(seed, grippers):
    keys = jax.random.split(jax.random.key(seed), 3)
    state = RopeState(
        points=jax.random.normal(keys[0], (4, 3)), grippers=jax.random.normal(keys[1], (grippers, 3))
    )
    return state, 0.1 * jax.random.normal(keys[2], (grippers, 3))


@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("symmetry", SYMMETRIES)
@pytest.mark.parametrize("grippers", [1, 2])
def test_what_goes_in_comes_out_again(origin, symmetry, grippers):
    sides = set()
    for seed in range(8):
        state, action = drawn(seed, grippers)
        frame = local_frame(state, action, origin, symmetry)
        sides.add(float(frame.side))
        inside = frame.points_in(state.points)
        np.testing.assert_allclose(frame.origin + frame.vectors_out(inside), state.points, atol=1e-5)
        np.testing.assert_allclose(frame.vectors_in(frame.vectors_out(action)), action, atol=1e-6)
        lengths = jnp.linalg.norm(state.points - frame.origin, axis=-1)
        np.testing.assert_allclose(jnp.linalg.norm(inside, axis=-1), lengths, rtol=1e-5)
    assert sides == ({1.0} if symmetry == "translation" else {1.0, -1.0})  # mirrored ones, too


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.floats(-3.1, 3.1), st.sampled_from([1, 2]), st.booleans())
def test_a_canonical_frame_sees_no_turn_about_the_vertical_no_shift_and_no_mirror(seed, yaw, count, mirror):
    here, there = seen_here_and_there(*drawn(seed, count), jnp.array(yaw), jnp.array(-1.0 if mirror else 1.0))
    for one, other in zip(here, there, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-5)


@jax.jit
def seen_here_and_there(state, action, yaw, side):
    """Points and action in a canonical frame; and when all was mirrored, turned and moved."""
    turn, shift = quaternion_from_yaw(yaw), jnp.array([0.7, -0.2, 0.4])
    flip = jnp.stack([1.0, side, 1.0])

    def moved(vectors):
        return rotate(turn, vectors * flip)

    def seen(state, action):
        frame = local_frame(state, action, "gripper", "canonical")
        return frame.points_in(state.points), frame.vectors_in(action)

    other = RopeState(moved(state.points) + shift, moved(state.grippers) + shift)
    return seen(state, action), seen(other, moved(action))


def test_a_canonical_frame_by_hand():
    # grippers along +y; the push is to the world's +x, which is to the right of +y: mirrored
    state = RopeState(jnp.zeros((3, 3)), jnp.array([[0.0, 1.0, 2.0], [0.0, 4.0, 2.0]]))
    action = jnp.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]])
    frame = local_frame(state, action, "gripper", "canonical")
    np.testing.assert_allclose(frame.x_axis, [0, 1], atol=1e-7)
    assert float(frame.side) == -1.0
    np.testing.assert_allclose(frame.vectors_in(action), [[0, 0.1, 0], [0, 0, 0]], atol=1e-7)
    np.testing.assert_allclose(frame.points_in(jnp.array([0.5, 3.0, 2.5])), [2.0, 0.5, 0.5], atol=1e-6)


def test_flat_and_back():
    state, _ = drawn(0, 2)
    points, grippers = unflat(flat(state.points, state.grippers), 4)
    assert np.array_equal(points, state.points) and np.array_equal(grippers, state.grippers)
