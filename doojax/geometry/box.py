"""Regions of space."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


@dataclass(frozen=True)
class Box:
    """An axis-aligned region, metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def sample(self, key: Array) -> Float[Array, "3"]:
        """A uniform point."""
        return jax.random.uniform(key, (3,), minval=jnp.array(self.low), maxval=jnp.array(self.high))

    def contains(self, points: Float[Array, "*b 3"]) -> Bool[Array, "*b"]:
        """Is each point inside?"""
        return ((points >= jnp.array(self.low)) & (points <= jnp.array(self.high))).all(-1)

    def clip(self, points: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
        """The nearest point inside."""
        return jnp.clip(points, jnp.array(self.low), jnp.array(self.high))
