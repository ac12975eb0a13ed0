"""Rotations, rigid frames and lengths.

Quaternions are unit, (w, x, y, z), body to world. Everything is written element by element, never as a plain
matrix product: by default GPUs may round the factors of float32 matrix products to three digits, millimetres
here.
"""

import functools

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float


def exact_product(left: Float[Array, "*b m k"], right: Float[Array, "*b k n"]) -> Float[Array, "*b m n"]:
    """The matrix product in the arguments' own precision, on GPUs too; for lengths, not for networks."""
    return jnp.matmul(left, right, precision=jax.lax.Precision.HIGHEST)


def rotate(quaternion: Float[Array, "*#b 4"], vector: Float[Array, "*#b 3"]) -> Float[Array, "*b 3"]:
    """Turn a vector from the body's axes to the world's."""
    quaternion, vector = same_rank(quaternion, vector)
    real, imaginary = quaternion[..., :1], quaternion[..., 1:]
    twice = 2 * jnp.cross(imaginary, vector)
    return vector + real * twice + jnp.cross(imaginary, twice)


def rotate_inverse(quaternion: Float[Array, "*#b 4"], vector: Float[Array, "*#b 3"]) -> Float[Array, "*b 3"]:
    """Turn a vector from the world's axes to the body's."""
    return rotate(quaternion_inverse(quaternion), vector)


def quaternion_inverse(quaternion: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """The rotation undone: the conjugate of a unit quaternion."""
    return jnp.concatenate([quaternion[..., :1], -quaternion[..., 1:]], axis=-1)


def quaternion_multiply(left: Float[Array, "*#b 4"], right: Float[Array, "*#b 4"]) -> Float[Array, "*b 4"]:
    """The rotation that first turns by ``right``, then by ``left``."""
    left, right = same_rank(left, right)
    real = left[..., :1] * right[..., :1] - jnp.sum(left[..., 1:] * right[..., 1:], axis=-1, keepdims=True)
    imaginary = (
        left[..., :1] * right[..., 1:]
        + right[..., :1] * left[..., 1:]
        + jnp.cross(left[..., 1:], right[..., 1:])
    )
    return jnp.concatenate([real, imaginary], axis=-1)


def quaternion_from_yaw(yaw: Float[Array, "*b"]) -> Float[Array, "*b 4"]:
    """The rotation by ``yaw`` radians about z, counter-clockwise seen from above."""
    zero = jnp.zeros_like(yaw)
    return jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)], axis=-1)


def quaternion_from_rotation_vector(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """The rotation about ``vector`` by its length in radians; smooth at zero, where it is none."""
    square = jnp.sum(vector * vector, axis=-1, keepdims=True)
    small = square < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    # the series' next term is below 1e-21
    real = jnp.where(small, 1 - square / 8 + square**2 / 384, jnp.cos(angle / 2))
    scale = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, jnp.sin(angle / 2) / angle)
    return jnp.concatenate([real, scale * vector], axis=-1)


def quaternion_yaw(quaternion: Float[Array, "*b 4"]) -> Float[Array, "*b"]:
    """Heading of the body's x axis in the world's xy plane, radians in (-pi, pi].

    The heading means nothing, and its gradient is not finite, where that axis stands vertical.
    """
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    return jnp.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def quaternion_to_matrix(quaternion: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """The rotation matrix, body to world: its columns are the body's axes."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def to_body(
    position: Float[Array, "*#b 3"], quaternion: Float[Array, "*#b 4"], points: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """World points (metres) as seen from a body at ``position`` with orientation ``quaternion``."""
    position, points = same_rank(position, points)
    return rotate_inverse(quaternion, points - position)


def to_world(
    position: Float[Array, "*#b 3"], quaternion: Float[Array, "*#b 4"], points: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """Points given in a body's frame (metres), in the world: the inverse of `to_body`."""
    turned, position = same_rank(rotate(quaternion, points), position)
    return turned + position


def same_rank(*arrays: Array) -> tuple[Array, ...]:
    """Arrays with axes of length one before their own, so that all have as many; numbers stay numbers.

    That is what broadcasting does, but said: under ``jax.numpy_rank_promotion("raise")`` JAX wants it said.
    """
    rank = max(jnp.ndim(array) for array in arrays)
    return tuple(
        jnp.reshape(array, (1,) * (rank - jnp.ndim(array)) + jnp.shape(array)) if jnp.ndim(array) else array
        for array in arrays
    )


def safe_norm(*components: Float[Array, "*#b"]) -> Float[Array, "*b"]:
    """Length of the vector with these components; its gradient at the zero vector is zero instead of NaN."""
    square = functools.reduce(jnp.add, (component * component for component in same_rank(*components)))
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)
