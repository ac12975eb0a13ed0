"""From a network's output to a probability that means what it says."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from doojax.modules import Jittable
from doojax.types import Obstacles, RopeState


class Calibration(Jittable):
    """A logit's calibrated probability: scaled and shifted before the logistic function (Platt 1999).

    At first it changes nothing. `doojax.learning.calibration` fits it; no gradient reaches it.
    """

    scale: Float[Array, ""]  # one over the temperature
    shift: Float[Array, ""]  # makes up for classes that were balanced in training

    def __init__(self, scale: float = 1.0, shift: float = 0.0):
        self.scale, self.shift = jnp.asarray(scale, dtype=float), jnp.asarray(shift, dtype=float)

    def __call__(self, logit: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """The probability."""
        return jax.nn.sigmoid(stop_gradient(self.scale) * logit + stop_gradient(self.shift))


class CalibratedClassifier(Jittable):
    """Probability that a predicted transition's error is below the threshold that it was trained for."""

    calibration: eqx.AbstractVar[Calibration]
    threshold: eqx.AbstractVar[Float[Array, ""]]

    def __call__(
        self,
        obstacles: Obstacles,
        state: RopeState,
        action: Float[Array, "G 3"],
        next_state: RopeState,
        uncertainty: Float[Array, ""],
    ) -> Float[Array, ""]:
        """See `doojax.models.protocols.Reliability`; a calibrated probability."""
        return self.calibration(self.logit(obstacles, state, action, next_state, uncertainty))

    @abstractmethod
    def logit(
        self,
        obstacles: Obstacles,
        state: RopeState,
        action: Float[Array, "G 3"],
        next_state: RopeState,
        uncertainty: Float[Array, ""],
    ) -> Float[Array, ""]:
        """The network's own output, before calibration."""
