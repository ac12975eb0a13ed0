"""A straight rope that lies on a slab, beside a post."""

import jax.numpy as jnp

from doojax.augmentation.projection import Problem
from doojax.types import Obstacles, ShapeKind

RADIUS = 0.01


def obstacles(dtype=jnp.float32):
    """A slab whose top is z = 0, and a box that stands on it at x = 0.3."""
    return Obstacles(
        kind=jnp.array([ShapeKind.BOX, ShapeKind.BOX]),
        centre=jnp.array([[0.0, 0.0, -0.1], [0.3, 0.0, 0.1]], dtype),
        quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]] * 2, dtype),
        half_size=jnp.array([[1.0, 1.0, 0.1], [0.05, 0.05, 0.1]], dtype),
        active=jnp.array([True, True]),
    )


def lying_rope(dtype=jnp.float32, height=0.0002, half_range=(0.25, 0.25, 0.25, 0.0, 0.0, 0.5)):
    """Nine points along y, ``height`` (m) above the slab."""
    y = jnp.linspace(-0.2, 0.2, 9, dtype=dtype)
    points = jnp.stack([jnp.zeros_like(y), y, jnp.full_like(y, RADIUS + height)], axis=-1)
    return Problem(
        points=points,
        radii=jnp.full(9, RADIUS, dtype),
        obstacles=obstacles(dtype),
        box_low=jnp.array([-0.9, -0.9, 0.0], dtype),
        box_high=jnp.array([0.9, 0.9, 0.9], dtype),
        low=-jnp.array(half_range, dtype),
        high=jnp.array(half_range, dtype),
    )
