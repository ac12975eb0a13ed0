"""From a network's output to a probability that means what it says."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from doojax.models.protocols import above
from doojax.modules import Jittable
from doojax.types import Judgement, Obstacles, Transition


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

    def __call__(self, obstacles: Obstacles, transition: Transition) -> Judgement:
        """See `doojax.models.protocols.Reliability`; the score is a calibrated probability."""
        return above(self.calibration(self.logit(obstacles, transition)), self.threshold)

    @abstractmethod
    def logit(self, obstacles: Obstacles, transition: Transition) -> Float[Array, ""]:
        """The network's own output, before calibration."""
