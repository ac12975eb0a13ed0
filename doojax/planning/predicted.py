"""MPPI over dynamics that are learned, priced by where those can be trusted.

The states of such rollouts are `doojax.types.Transition`: a term finds where one led in its ``next_state``,
and a `doojax.models.protocols.Reliability` judges it like any other.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.models.protocols import Dynamics, Reliability, predicted
from doojax.modules import Jittable
from doojax.types import Judgement, Transition


class PredictedRollouts(Jittable):
    """`doojax.planning.mppi.Rollouts` of dynamics; a control is a flat action, durations do not count."""

    dynamics: Dynamics
    obstacles: Any
    action: tuple[int, ...] = eqx.field(static=True)  # its shape

    def __call__(
        self, state: Any, controls: Float[Array, "K H U"], durations: Float[Array, "K"]
    ) -> Transition:
        """Transitions [K, H]."""

        def one(controls: Float[Array, "H U"]) -> Transition:
            def go_on(state: Any, control: Float[Array, "U"]) -> tuple[Any, Transition]:
                found = predicted(self.dynamics, self.obstacles, state, control.reshape(self.action))
                return found.next_state, found

            return jax.lax.scan(go_on, state, controls)[1]

        return jax.vmap(one)(controls)


def refused(judgement: Judgement) -> Float[Array, ""]:
    """The price of one for a transition that is not accepted."""
    return jnp.where(judgement.accepted, 0.0, 1.0)


class Unreliable(Jittable):
    """A `doojax.planning.mppi.Term`: the prices of all transitions, by what a reliability says of each."""

    reliability: Reliability
    obstacles: Any
    weight: float = 1.0
    price: Callable[[Judgement], Float[Array, ""]] = eqx.field(static=True, default=refused)

    def __call__(self, transitions: Transition, controls: Float[Array, "H U"]) -> Float[Array, ""]:
        """Of one trajectory."""
        judged = jax.vmap(lambda one: self.reliability(self.obstacles, one))(transitions)
        return self.weight * jax.vmap(self.price)(judged).sum()
