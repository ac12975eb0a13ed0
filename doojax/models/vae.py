"""A variational autoencoder of whole examples: what augments in the thesis's comparison (section 3.5)."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from doojax.modules import Jittable
from doojax.types import Size

LAYERS = 4  # of the encoder and of the decoder, beside what reads the latent numbers off


@dataclass(frozen=True)
class VaeConfig:
    """What a `Vae` is built from."""

    inputs: Size
    hidden: Size
    latent: Size


class Vae(Jittable):
    """p(x | z) is normal about the decoder's output with one learned scale, p(z) standard normal.

    Kingma and Welling 2014; sizes and activations as in the thesis's released code.
    """

    encoder: eqx.nn.MLP
    decoder: eqx.nn.MLP
    log_scale: Float[Array, ""]
    config: VaeConfig = eqx.field(static=True)

    def __init__(self, config: VaeConfig, *, key: Array):
        """Random weights."""
        into, out = jax.random.split(key)
        sizes = {"width_size": config.hidden, "depth": LAYERS, "activation": jax.nn.leaky_relu}
        self.encoder = eqx.nn.MLP(config.inputs, 2 * config.latent, **sizes, key=into)
        self.decoder = eqx.nn.MLP(config.latent, config.inputs, **sizes, key=out)
        self.log_scale = jnp.zeros(())
        self.config = config

    def encoded(self, x: Float[Array, "i"]) -> tuple[Float[Array, "l"], Float[Array, "l"]]:
        """Mean and log variance of q(z | x)."""
        mean, log_variance = jnp.split(self.encoder(x), 2)
        return mean, log_variance

    def loss(self, x: Float[Array, "i"], key: Key[Array, ""]) -> Float[Array, ""]:
        """The negative evidence lower bound of one example, in nats, with one sample of z."""
        mean, log_variance = self.encoded(x)
        z = mean + jnp.exp(log_variance / 2) * jax.random.normal(key, mean.shape)
        off = (x - self.decoder(z)) / jnp.exp(self.log_scale)
        unlikely = (0.5 * off**2 + self.log_scale + 0.5 * jnp.log(2 * jnp.pi)).sum()
        return divergence(mean, log_variance) + unlikely

    def varied(
        self, x: Float[Array, "i"], key: Key[Array, ""], temperature: float = 10.0
    ) -> Float[Array, "i"]:
        """Another example like this one: q's standard deviation is divided by the temperature."""
        mean, log_variance = self.encoded(x)
        spread = jnp.exp(log_variance / 2) / temperature
        return self.decoder(mean + spread * jax.random.normal(key, mean.shape))


def divergence(mean: Float[Array, "l"], log_variance: Float[Array, "l"]) -> Float[Array, ""]:
    """Kullback-Leibler divergence of N(mean, variance) from the standard normal, nats."""
    return 0.5 * (jnp.exp(log_variance) + mean**2 - 1 - log_variance).sum()
