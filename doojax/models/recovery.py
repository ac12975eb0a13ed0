"""Which action frees a rope whose motion cannot be predicted (thesis sections 2.3.6 and 2.3.7)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.geometry.frames import exact_product
from doojax.models.classifier import ClassifierConfig, DistanceClassifier
from doojax.modules import Jittable
from doojax.types import Obstacles, RopeState, Transition


class RecoveryNetwork(Jittable):
    """Probability that an action leads to where actions are accepted again.

    The thesis takes the classifier's convolutions as they are and trains two layers behind them; here all
    weights begin with the classifier's and go on learning, which needs no choice of what to freeze. No
    prediction is used, because none can be trusted: the encoder sees the rope move along with the grippers.
    """

    network: DistanceClassifier

    def __init__(self, config: ClassifierConfig, *, key: Array):
        self.network = DistanceClassifier(config, key=key)

    def __call__(
        self, obstacles: Obstacles, state: RopeState, action: Float[Array, "G 3"]
    ) -> Float[Array, ""]:
        """See `doojax.models.protocols.Recovery`."""
        return jax.nn.sigmoid(self.logit(obstacles, state, action))

    def logit(self, obstacles: Obstacles, state: RopeState, action: Float[Array, "G 3"]) -> Float[Array, ""]:
        """The network's own output."""
        moved = Transition(state, action, carried_along(state, action), jnp.zeros(()))
        return self.network.logit(obstacles, moved)


def carried_along(state: RopeState, action: Float[Array, "G 3"]) -> RopeState:
    """Every point of the rope displaced as the grippers are, in proportion to how near they are along it."""
    count, grippers = state.points.shape[0], state.grippers.shape[0]
    if grippers == 1:
        share = jnp.ones((count, 1))
    else:
        place = jnp.linspace(0.0, 1.0, count)[:, None]
        share = jnp.concatenate([1 - place, place], axis=1)
    return RopeState(points=state.points + exact_product(share, action), grippers=state.grippers + action)
