"""Which transforms of a task's examples are valid, learned from the simulator (thesis 3.3.3)."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from doojax.modules import Jittable
from doojax.types import Depth, Size


@dataclass(frozen=True)
class ValidityConfig:
    """What a `TransformValidity` is built from; the thesis's sizes."""

    width: Size = 256
    depth: Depth = 2  # hidden layers


class TransformValidity(Jittable):
    """How far (m) an example that was moved comes out from where it should, of the transform alone: f_valid.

    Called, it is equation 3.4 with a hinge: what is below ``limit`` counts for nothing.
    """

    network: eqx.nn.MLP
    input_scale: Float[Array, "6"]  # what transforms are in units of
    output_scale: Float[Array, ""]  # m
    limit: Float[Array, ""]  # m
    config: ValidityConfig = eqx.field(static=True)

    def __init__(self, config: ValidityConfig, *, key: Array):
        """Random weights; scales of one, a limit of zero."""
        self.network = eqx.nn.MLP(6, "scalar", config.width, config.depth, key=key)
        self.input_scale, self.output_scale, self.limit = jnp.ones(6), jnp.ones(()), jnp.zeros(())
        self.config = config

    def error(self, parameters: Float[Array, "6"]) -> Float[Array, ""]:
        """Of a translation (m) and rotation vector (rad) about the example's centre, m; never negative."""
        scaled = parameters / stop_gradient(self.input_scale)
        return stop_gradient(self.output_scale) * jax.nn.softplus(self.network(scaled))

    def __call__(self, parameters: Float[Array, "6"]) -> Float[Array, ""]:
        """By how much the error exceeds ``limit``, m: 0 for what is valid."""
        return jnp.maximum(self.error(parameters) - stop_gradient(self.limit), 0.0)

    def limited(self, limit: float) -> "TransformValidity":
        """One that calls valid what errs by less than ``limit``, m."""
        return eqx.tree_at(lambda model: model.limit, self, jnp.asarray(limit, self.limit.dtype))
