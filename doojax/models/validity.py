"""Which transforms of a task's examples are valid, learned from the simulator (thesis 3.3.3)."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from doojax.geometry.motion import RigidMotion
from doojax.modules import Jittable
from doojax.types import Depth, Size

SEEN, DIFFERENCES = 9, 8  # numbers into the network and out
LEAST = 1e-4  # of the output's unit, so that the root has a derivative everywhere


@dataclass(frozen=True)
class ValidityConfig:
    """What a `TransformValidity` is built from; the thesis's sizes."""

    width: Size = 256
    depth: Depth = 2  # hidden layers


class TransformValidity(Jittable):
    """How far (m) an example that was moved comes out from where it should, of the transform alone: f_valid.

    Called, it is equation 3.4 with a hinge: what is below ``limit`` counts for nothing. Beside the transform
    the network sees where up is after it: turned about the upright, a rope hangs as before. The error is the
    length of a difference, of the network's output for the transform to that for none, so that no transform
    has no error; a number alone has to learn that from few examples, and was 3 cm off.
    """

    network: eqx.nn.MLP
    input_scale: Float[Array, "6"]  # what transforms are in units of
    output_scale: Float[Array, ""]  # m
    limit: Float[Array, ""]  # m
    config: ValidityConfig = eqx.field(static=True)

    def __init__(self, config: ValidityConfig, *, key: Array):
        """Random weights; scales of one, a limit of zero."""
        self.network = eqx.nn.MLP(SEEN, DIFFERENCES, config.width, config.depth, key=key)
        self.input_scale, self.output_scale, self.limit = jnp.ones(6), jnp.ones(()), jnp.zeros(())
        self.config = config

    def error(self, parameters: Float[Array, "6"]) -> Float[Array, ""]:
        """Of a translation (m) and rotation vector (rad) about the example's centre, m; never negative."""
        upright = jnp.array([0.0, 0.0, 1.0], parameters.dtype)
        tilt = RigidMotion.of(parameters, jnp.zeros_like(upright)).vectors(upright[None])[0] - upright
        seen = jnp.concatenate([parameters / stop_gradient(self.input_scale), tilt])
        difference = self.network(seen) - self.network(jnp.zeros_like(seen))
        return stop_gradient(self.output_scale) * jnp.sqrt((difference**2).sum() + LEAST**2)

    def __call__(self, parameters: Float[Array, "6"]) -> Float[Array, ""]:
        """By how much the error exceeds ``limit``, m: 0 for what is valid."""
        return jnp.maximum(self.error(parameters) - stop_gradient(self.limit), 0.0)

    def limited(self, limit: float) -> "TransformValidity":
        """One that calls valid what errs by less than ``limit``, m."""
        return eqx.tree_at(lambda model: model.limit, self, jnp.asarray(limit, self.limit.dtype))
