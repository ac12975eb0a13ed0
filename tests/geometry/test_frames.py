import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from doojax.geometry import frames

rng = np.random.default_rng(0)
ROTATIONS = Rotation.random(50, rng=rng)
OTHERS = Rotation.random(50, rng=rng)
QUATERNIONS = jnp.asarray(ROTATIONS.as_quat(scalar_first=True), float)
VECTORS = rng.normal(size=(50, 3))
POINTS = jnp.asarray(VECTORS, float)
close = {"rtol": 0, "atol": 2e-6}


def same_rotation(quaternion, rotation):
    expected = rotation.as_quat(scalar_first=True)
    agreement = np.sum(np.asarray(quaternion) * expected, axis=-1)
    np.testing.assert_allclose(np.abs(agreement), 1, atol=1e-6)


def test_rotate_turns_as_scipy_does():
    np.testing.assert_allclose(frames.rotate(QUATERNIONS, POINTS), ROTATIONS.apply(VECTORS), **close)
    np.testing.assert_allclose(
        frames.rotate_inverse(QUATERNIONS, POINTS), ROTATIONS.inv().apply(VECTORS), **close
    )


def test_multiply_and_inverse_compose_as_scipy_does():
    others = jnp.asarray(OTHERS.as_quat(scalar_first=True), float)
    same_rotation(frames.quaternion_multiply(QUATERNIONS, others), ROTATIONS * OTHERS)
    same_rotation(frames.quaternion_inverse(QUATERNIONS), ROTATIONS.inv())


def test_matrix_equals_scipy_and_holds_the_body_axes():
    matrix = frames.quaternion_to_matrix(QUATERNIONS)
    np.testing.assert_allclose(matrix, ROTATIONS.as_matrix(), **close)
    x_axis = frames.rotate(QUATERNIONS, jnp.array([1.0, 0, 0]))
    np.testing.assert_allclose(matrix[:, :, 0], x_axis, **close)


def test_yaw_round_trip_and_heading():
    yaw = jnp.linspace(-3.1, 3.1, 21)
    np.testing.assert_allclose(frames.quaternion_yaw(frames.quaternion_from_yaw(yaw)), yaw, **close)
    same_rotation(frames.quaternion_from_yaw(yaw), Rotation.from_euler("z", np.asarray(yaw)[:, None]))
    heading = ROTATIONS.apply([1, 0, 0])
    expected = np.arctan2(heading[:, 1], heading[:, 0])
    np.testing.assert_allclose(frames.quaternion_yaw(QUATERNIONS), expected, atol=2e-5)


def test_to_world_undoes_to_body():
    position = POINTS[::-1]
    body = frames.to_body(position, QUATERNIONS, POINTS)
    expected = ROTATIONS.inv().apply(VECTORS - VECTORS[::-1])
    np.testing.assert_allclose(body, expected, **close)
    np.testing.assert_allclose(frames.to_world(position, QUATERNIONS, body), POINTS, **close)


def test_one_pose_serves_many_points():
    one = frames.to_body(POINTS[0], QUATERNIONS[0], POINTS)
    each = jax.vmap(frames.to_body, (None, None, 0))(POINTS[0], QUATERNIONS[0], POINTS)
    np.testing.assert_allclose(one, each, **close)


def test_safe_norm_is_the_length_and_has_a_gradient_everywhere():
    def length(v):
        return frames.safe_norm(v[0], v[1], v[2])

    values, gradients = jax.vmap(jax.value_and_grad(length))(POINTS)
    np.testing.assert_allclose(values, np.linalg.norm(VECTORS, axis=-1), rtol=1e-6)
    np.testing.assert_allclose(gradients, VECTORS / np.linalg.norm(VECTORS, axis=-1)[:, None], atol=1e-6)
    assert jnp.all(jax.grad(length)(jnp.zeros(3)) == 0)


@pytest.mark.parametrize("shape", [(4,), (2, 4), (2, 3, 4)])
def test_batch_axes_come_first(shape):
    quaternion = jnp.zeros(shape).at[..., 0].set(1)
    assert frames.quaternion_to_matrix(quaternion).shape == (*shape[:-1], 3, 3)
    vector = jnp.arange(3.0)
    assert frames.rotate(quaternion, vector).shape == (*shape[:-1], 3)
