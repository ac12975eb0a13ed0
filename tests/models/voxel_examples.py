"""Small scenes and views that the tests of networks with voxels share."""

import jax.numpy as jnp

from doojax.models.rasters import ViewConfig
from doojax.types import Obstacles, RopeState, ShapeKind

FLAT = ViewConfig(1, "gripper", 14, 2, 0.02, channels=4, layers=2, kernel_up=1, pool_up=1)
DEEP = ViewConfig(2, "centroid", 12, 12, 0.05, channels=4, layers=2)


def box(*centre, half=(0.05, 0.05, 0.05), active=True):
    """One box along the world's axes."""
    return Obstacles(
        kind=jnp.full(1, ShapeKind.BOX, jnp.int32),
        centre=jnp.array([centre], float),
        quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
        half_size=jnp.array([half], float),
        active=jnp.array([active]),
    )


def rope(x=0.0, y=0.0, z=0.02, points=3, grippers=1):
    """A straight rope along x that ends at (x, y, z), held there and, with two grippers, at its other end."""
    xs = x - 0.05 * jnp.arange(points)[::-1]
    line = jnp.stack([xs, jnp.full(points, y), jnp.full(points, z)], axis=1)
    return RopeState(points=line, grippers=line[-1:] if grippers == 1 else line[jnp.array([0, -1])])
