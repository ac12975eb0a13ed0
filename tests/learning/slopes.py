"""A world in one dimension: what is done moves a point by a factor, which a model of one number learns."""

import equinox as eqx
import jax
import jax.numpy as jnp

from doojax.learning.data import Trajectories
from doojax.types import Obstacles

SOURCE, FREE, STUCK = 1.0, 1.2, 0.0  # factors of the source, and of both parts of the target


class Place(eqx.Module):
    """A point on the x axis: a `doojax.types.State`."""

    x: jax.Array

    @property
    def passive(self):
        return 1

    def bodies(self):
        return jnp.stack([self.x, 0 * self.x, 0 * self.x], axis=-1)[..., None, :]

    def moved(self, motion):
        raise NotImplementedError


class Slope(eqx.Module):
    """Moves a point by the action times a number."""

    slope: jax.Array

    def __call__(self, obstacles, state, action):
        return Place(state.x + self.slope * action[0]), jnp.zeros(())


def source():
    return Slope(jnp.asarray(SOURCE))


def moves(count, length=4, seed=0, factor=None):
    """Trajectories that go by FREE to the left of 0, and do not move right of it; or all by one factor."""
    key_x, key_a = jax.random.split(jax.random.key(seed))
    start = jnp.where(jnp.arange(count) % 2 == 0, -50.0, 50.0) + jax.random.normal(key_x, (count,))
    actions = jax.random.uniform(key_a, (count, length, 1), minval=-1.0)
    own = jnp.where(start < 0, FREE, STUCK) if factor is None else jnp.full(count, factor)
    path = jnp.concatenate([jnp.zeros((count, 1)), jnp.cumsum(own[:, None] * actions[..., 0], 1)], 1)
    nothing = Obstacles(
        kind=jnp.zeros((count, 1), jnp.int32),
        centre=jnp.zeros((count, 1, 3)),
        quaternion=jnp.ones((count, 1, 4)),
        half_size=jnp.ones((count, 1, 3)),
        active=jnp.zeros((count, 1), bool),
    )
    return Trajectories(Place(start[:, None] + path), actions, nothing, jnp.arange(count))
