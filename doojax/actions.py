"""What a task's actions are: arrays whose meaning an action space holds.

Whoever plans or collects sees actions through this alone: displacements of grippers, velocities of joints,
the acceleration of a point.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from doojax.keys import stream
from doojax.types import State

CANDIDATES = 32  # tried at once where a sample may be invalid


@runtime_checkable
class ActionSpace(Protocol):
    """All actions of a task, each for one element; hashable, because planners are compiled for it.

    States are those of the task, see `doojax.types.State`.
    """

    @property
    def longest(self) -> float:
        """No action is longer, in the actions' own unit."""
        ...

    @property
    def repeats(self) -> float:
        """How often random data take the action before again, a probability."""
        ...

    def draw(self, key: Array) -> Float[Array, "..."]:
        """An action that may be invalid in a given state, from the distribution of random data."""
        ...

    def valid(self, state: Any, action: Float[Array, "..."]) -> Bool[Array, ""]:
        """May it be taken there? One longer than `longest` may not."""
        ...

    def retreat(self, state: Any) -> Float[Array, "..."]:
        """The action that leads back to where others are valid."""
        ...

    def missing(self, state: Any, action: Float[Array, "..."], aim: Float[Array, "K 3"]) -> Float[Array, ""]:
        """How far what is commanded will be from where ``aim`` has the bodies: smaller is better."""
        ...

    def between(self, state: Any, later: Any, steps: int) -> Float[Array, "..."]:
        """What, taken ``steps`` times, brings all that is commanded from one state to where it is in another.

        Where there is no such action, any other.
        """
        ...


@runtime_checkable
class DrawsWhereItIs(Protocol):
    """What an action space may have besides: random data whose actions depend on the state."""

    def draw_in(self, key: Array, state: Any) -> Float[Array, "..."]:
        """An action of random data in a given state; it may be invalid there."""
        ...


def nothing_of(space: ActionSpace) -> Float[Array, "..."]:
    """Zeros of an action's shape."""
    drawn = jax.eval_shape(space.draw, stream(0, "shape"))
    return jnp.zeros(drawn.shape, drawn.dtype)


def first_valid(
    key: Array, draw: Callable[[Array], Array], valid: Callable[[Array], Bool[Array, ""]], fallback: Array
) -> Array:
    """The first of `CANDIDATES` draws that is valid, else ``fallback``: rejection with a bounded cost."""
    candidates = jax.vmap(draw)(jax.random.split(key, CANDIDATES))
    accepted = jax.vmap(valid)(candidates)
    return jnp.where(accepted.any(), candidates[jnp.argmax(accepted)], fallback)


def sampled(
    space: ActionSpace, key: Array, state: State, previous: Float[Array, "..."]
) -> Float[Array, "..."]:
    """``previous`` as often as the space repeats actions, if it is valid and not zero; else another.

    That is the first valid one of some that are drawn anew, or where none of them is, the space's retreat.
    """
    repeat_key, draw_key = jax.random.split(key)
    repeat = (jax.random.uniform(repeat_key) < space.repeats) & (previous != 0).any()

    def valid(action):
        return space.valid(state, action)

    def draw(key):
        return space.draw_in(key, state) if isinstance(space, DrawsWhereItIs) else space.draw(key)

    fresh = first_valid(draw_key, draw, valid, fallback=space.retreat(state))
    return jnp.where(repeat & valid(previous), previous, fresh)
