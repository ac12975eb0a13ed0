"""What a planner needs of a model: three functions of one element, to be batched by `jax.vmap`.

Models are equinox modules, so that they pass through `jax.jit` and `jax.vmap` as arguments.
"""

from typing import Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float

from doojax.types import Obstacles, RopeState


@runtime_checkable
class Dynamics(Protocol):
    """Predicts what one action does, h(E, s, a) in the thesis."""

    def __call__(
        self, obstacles: Obstacles, state: RopeState, action: Float[Array, "G 3"]
    ) -> tuple[RopeState, Float[Array, ""]]:
        """The next state and how uncertain it is.

        Args:
            obstacles: one set [M]; a model of unconstrained motion does not look at it.
            state: points [N, 3] and grippers [G, 3], world frame, metres.
            action: gripper displacements, metres.

        Returns:
            the next state, and a number that grows with doubt; 0 for a model that has none. For an ensemble
            it is the sum over the state's coordinates of the standard deviation among members, metres.
        """
        ...


@runtime_checkable
class Reliability(Protocol):
    """Judges whether a predicted transition can be trusted, g(E, s, a, s', sigma) in the thesis."""

    @property
    def threshold(self) -> Float[Array, ""] | float:
        """A transition is accepted if its score exceeds this."""
        ...

    def __call__(
        self,
        obstacles: Obstacles,
        state: RopeState,
        action: Float[Array, "G 3"],
        next_state: RopeState,
        uncertainty: Float[Array, ""],
    ) -> Float[Array, ""]:
        """A score: the larger, the more trusted. Of a classifier, the probability that the error is small.

        Args:
            obstacles: one set [M].
            state: where the transition begins; itself predicted, but for the root of a plan.
            action: gripper displacements, metres.
            next_state: the prediction of a `Dynamics`.
            uncertainty: its second result.
        """
        ...


@runtime_checkable
class Recovery(Protocol):
    """Judges actions where no prediction can be trusted."""

    def __call__(
        self, obstacles: Obstacles, state: RopeState, action: Float[Array, "G 3"]
    ) -> Float[Array, ""]:
        """How likely the action leads to where predictions can be trusted again; arguments as above."""
        ...


def accepts(
    reliability: Reliability,
    obstacles: Obstacles,
    state: RopeState,
    action: Float[Array, "G 3"],
    next_state: RopeState,
    uncertainty: Float[Array, ""],
) -> Bool[Array, ""]:
    """Does ``reliability`` accept this transition?"""
    return reliability(obstacles, state, action, next_state, uncertainty) > reliability.threshold
