"""What a planner needs of a model: three functions of one element, to be batched by `jax.vmap`.

Models are equinox modules, so that they pass through `jax.jit` and `jax.vmap` as arguments. States and
actions are a task's own: see `doojax.types.State` and `doojax.actions.ActionSpace`.
"""

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.types import Judgement, Obstacles, Transition


@runtime_checkable
class Dynamics(Protocol):
    """Predicts what one action does, h(E, s, a) in the thesis."""

    def __call__(
        self, obstacles: Any, state: Any, action: Float[Array, "..."]
    ) -> tuple[Any, Float[Array, ""]]:
        """The next state and how uncertain it is.

        Args:
            obstacles: one set [M]; a model of unconstrained motion does not look at it.
            state: one.
            action: one of the task's action space.

        Returns:
            the next state, of the same type, and a number that grows with doubt; 0 for a model that has none.
            For an ensemble it is the sum over the state's coordinates of the standard deviation among
            members, metres.
        """
        ...


@runtime_checkable
class Reliability(Protocol):
    """Judges whether a predicted transition can be trusted, g(E, s, a, s', sigma) in the thesis."""

    def __call__(self, obstacles: Obstacles, transition: Transition) -> Judgement:
        """A score in a unit of its own (a probability, metres), and what follows from it.

        Args:
            obstacles: one set [M].
            transition: one, as a `Dynamics` predicts it.
        """
        ...


@runtime_checkable
class Recovery(Protocol):
    """Judges actions where no prediction can be trusted."""

    def __call__(self, obstacles: Any, state: Any, action: Float[Array, "..."]) -> Float[Array, ""]:
        """How likely the action leads to where predictions can be trusted again; arguments as above."""
        ...


def above(score: Float[Array, "*b"], threshold: Float[Array, ""] | float) -> Judgement:
    """What something learned says: accepted above the threshold, and never impossible."""
    accepted = score > threshold
    return Judgement(score, accepted, jnp.ones_like(accepted))


def predicted(dynamics: Dynamics, obstacles: Any, state: Any, action: Float[Array, "..."]) -> Transition:
    """The transition that dynamics predict."""
    return Transition(state, action, *dynamics(obstacles, state, action))
