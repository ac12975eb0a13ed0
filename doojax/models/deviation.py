"""How far off a prediction will be, in metres: the model deviation estimator (thesis 4.3.2.2)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from doojax.models.classifier import ClassifierConfig, DistanceClassifier
from doojax.models.pouring import PouringJudge, PouringJudgeConfig
from doojax.modules import Jittable
from doojax.types import Judgement, Obstacles, Transition

SMALLEST = 1e-6  # m


class DeviationEstimator(Jittable):
    """The error of a predicted transition, from what `DistanceClassifier` looks at.

    Deviation is `doojax.learning.labels.rms_distance`, root mean square over a rope's points, metres; the
    released code's is sqrt(N) times that. A transition is accepted where the deviation, or its upper bound,
    is below ``limit``, d_max in the thesis.
    """

    network: DistanceClassifier | PouringJudge
    scale: Float[Array, ""]  # m, what the network's output is in units of; no gradient reaches it
    power: Float[Array, ""]  # with shift, the calibration: log true = shift + power log predicted
    shift: Float[Array, ""]
    limit: Float[Array, ""]  # m, d_max
    factor: Float[Array, ""]  # from the deviation to the bound that judges: 1 is none

    def __init__(self, config: ClassifierConfig | PouringJudgeConfig, *, key: Array):
        if isinstance(config, PouringJudgeConfig):
            self.network = PouringJudge(config, key=key)
        else:
            self.network = DistanceClassifier(config, key=key)
        self.scale, self.power, self.factor = jnp.ones(()), jnp.ones(()), jnp.ones(())
        self.shift, self.limit = jnp.zeros(()), jnp.ones(())

    def __call__(self, obstacles: Obstacles, transition: Transition) -> Judgement:
        """See `doojax.models.protocols.Reliability`; the score is what is compared with ``limit``, metres."""
        bound = self.factor * self.deviation(obstacles, transition)
        return Judgement(bound, bound < self.limit, jnp.ones_like(bound, dtype=bool))

    def deviation(self, obstacles: Obstacles, transition: Transition) -> Float[Array, ""]:
        """The expected deviation, m, calibrated."""
        raw = self.uncalibrated(obstacles, transition)
        return jnp.exp(self.shift + self.power * jnp.log(raw + SMALLEST))

    def uncalibrated(self, obstacles: Obstacles, transition: Transition) -> Float[Array, ""]:
        """The network's own, m: never negative."""
        return stop_gradient(self.scale) * jax.nn.softplus(self.network.logit(obstacles, transition))

    def bounded(self, factor: float) -> "DeviationEstimator":
        """One that judges by an upper bound, such as `doojax.learning.calibration.conformal_factor` gives."""
        return eqx.tree_at(lambda model: model.factor, self, jnp.asarray(factor, self.factor.dtype))

    def limited(self, limit: float) -> "DeviationEstimator":
        """One with another d_max, m."""
        return eqx.tree_at(lambda model: model.limit, self, jnp.asarray(limit, self.limit.dtype))
