"""How near segments come, beside MuJoCo's capsules and samples along them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from doojax.geometry import FAR, segment_signed_distance, signed_distance
from doojax.types import ShapeKind
from tests.geometry.shapes import in_mujoco, one_shape, random_obstacles

distance, segment_distance = jax.jit(signed_distance), jax.jit(segment_signed_distance)


def test_no_active_obstacle_is_far_away():
    obstacles, points = random_obstacles(np.random.default_rng(4)), jnp.ones((20, 3))
    parked = eqx.tree_at(lambda o: o.active, obstacles, jnp.zeros(9, bool))
    for empty in (parked, jax.tree.map(lambda field: field[:0], obstacles)):
        assert np.all(segment_distance(empty, points, points + 1) == FAR)


def test_segments_equal_mujoco_capsules_where_they_are_apart():
    rng = np.random.default_rng(8)
    obstacles = random_obstacles(rng)
    radius, half_length = 0.01, 0.15
    centres = rng.uniform(-1, 1, (200, 3))
    turns = Rotation.random(200, rng=rng)
    half = turns.apply([0, 0, half_length])
    ours = segment_distance(obstacles, jnp.asarray(centres - half, float), jnp.asarray(centres + half, float))
    mujoco_distances = in_mujoco(obstacles, ShapeKind.CAPSULE, [radius, half_length, 0])
    theirs = np.array(
        [
            min(mujoco_distances(centre, quaternion))
            for centre, quaternion in zip(centres, turns.as_quat(scalar_first=True), strict=True)
        ]
    )
    apart = theirs > 1e-4
    assert np.count_nonzero(apart) > 80
    np.testing.assert_allclose(ours[apart] - radius, theirs[apart], atol=2e-5)
    assert np.all(ours[theirs < -1e-4] < radius)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 2))
def test_segments_find_the_least_of_many_samples(seed, length):
    rng = np.random.default_rng(seed)
    obstacles = random_obstacles(rng)
    start = rng.uniform(-0.8, 0.8, (20, 3))
    direction = rng.normal(size=(20, 3))
    end = start + length * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    fractions = np.linspace(0, 1, 201)[:, None, None]
    samples = distance(obstacles, jnp.asarray(start + fractions * (end - start), float)).min(axis=0)
    found = segment_distance(obstacles, jnp.asarray(start, float), jnp.asarray(end, float))
    assert np.all(found <= samples + 3e-6)
    assert np.all(found >= samples - length / 400 - 3e-6)


def test_a_link_through_a_thin_wall_is_inside_it():
    wall = one_shape(ShapeKind.BOX, (0.0005, 1, 1))
    start, end = jnp.array([-0.0181, 0.2, 0.1]), jnp.array([0.0329, 0.2, 0.1])
    assert distance(wall, jnp.stack([start, end])).min() > 0.017
    np.testing.assert_allclose(segment_distance(wall, start, end), -0.0005, atol=1e-6)


def test_segment_gradient_equals_finite_differences():
    rng = np.random.default_rng(9)
    with jax.enable_x64(True):
        obstacles = random_obstacles(rng)
        ends = jnp.asarray(rng.uniform(-0.8, 0.8, (200, 2, 3)))

        @jax.jit
        def value(ends):
            return segment_signed_distance(obstacles, ends[..., 0, :], ends[..., 1, :])

        slope = np.asarray(jax.jit(jax.grad(lambda ends: value(ends).sum()))(ends))
        assert np.all(np.isfinite(slope))
        step = 1e-5 * np.eye(6).reshape(6, 2, 3)
        here, ahead, behind = np.split(
            np.asarray(value(ends[:, None] + np.concatenate([np.zeros((1, 2, 3)), step, -step]))),
            [1, 7],
            axis=1,
        )
        numeric = ((ahead - behind) / 2e-5).reshape(-1, 2, 3)
        outside = here[:, 0] > 0  # inside, the deepest point mostly lies on a kink
        assert np.count_nonzero(outside) > 50
        np.testing.assert_allclose(slope[outside], numeric[outside], atol=1e-4)
