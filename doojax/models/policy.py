"""A policy: numbers that command an action, from one vector that is seen."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.modules import Jittable
from doojax.types import Depth, Size


@dataclass(frozen=True)
class PolicyConfig:
    """Sizes of a `Policy`."""

    observation: Size  # D, the numbers that it sees, see doojax.environments.features
    action: Size  # U, the numbers that it gives, see doojax.environments.command
    width: Size  # of its hidden layers
    depth: Depth  # how many of them


class Policy(Jittable):
    """A perceptron of scaled observations; the mode of a distribution that was trained by trying."""

    mean: Float[Array, "D"]  # of observations
    scale: Float[Array, "D"]  # by which they are divided
    network: eqx.nn.MLP

    def __init__(self, config: PolicyConfig, *, key: Array):
        """A network with random weights."""
        self.mean, self.scale = jnp.zeros(config.observation), jnp.ones(config.observation)
        self.network = eqx.nn.MLP(
            config.observation, config.action, config.width, config.depth, jax.nn.swish, key=key
        )

    def __call__(self, observation: Float[Array, "D"]) -> Float[Array, "U"]:
        """What to do: numbers from -1 to 1."""
        return jnp.tanh(self.network((observation - self.mean) / self.scale))
