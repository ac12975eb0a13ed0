"""Trap detection: has control stopped making progress?

After McConachie et al., as the thesis's section 5.4 has it. Over a window of positions q_1 ... q_T the mean
change in a step is that of abs(q_T - q_1) / T over all coordinates; it is compared with the largest that was
seen. Thesis and released code differ in when that largest is forgotten, see `TrapSettings.keeps_highest`.
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


@dataclass(frozen=True)
class TrapSettings:
    """The released code's, in which a step lasts 0.1 to 0.3 s and coordinates are radians and metres."""

    window: int = 8  # positions
    threshold: float = 0.25  # of the largest change, below which control is trapped; the thesis: 0.2 to 0.3
    least: float = 0.0075  # that the largest change counts as, at least
    keeps_highest: bool = (
        False  # over the whole trial, as in the thesis; else a regrasp forgets it, as in code
    )

    def __post_init__(self):
        """Refuse what never detects anything, or always does."""
        if self.window < 2:
            raise ValueError(f"the window is {self.window} positions, expected 2 or more")
        for name in ("threshold", "least"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0")


class TrapState(eqx.Module):
    """What is remembered."""

    positions: Float[Array, "W D"]  # the latest last
    count: Int[Array, ""]  # of positions since the last regrasp
    highest: Float[Array, ""]  # change that was seen


def watched(size: int, settings: TrapSettings) -> TrapState:
    """Nothing seen yet of so many coordinates."""
    return TrapState(
        jnp.zeros((settings.window, size)), jnp.zeros((), int), jnp.asarray(settings.least, float)
    )


def seen(
    state: TrapState, position: Float[Array, "D"], settings: TrapSettings
) -> tuple[TrapState, Bool[Array, ""], Float[Array, ""]]:
    """After one more position: the state, whether control is trapped, and the ratio that says so.

    As long as the window is not full, the ratio is 1.
    """
    positions = jnp.concatenate([state.positions[1:], position[None]])
    count = state.count + 1
    full = count >= settings.window
    change = jnp.abs(positions[-1] - positions[0]).mean() / settings.window
    highest = jnp.where(full, jnp.maximum(state.highest, change), state.highest)
    ratio = jnp.where(full, jnp.minimum(change / highest, 1), 1.0)
    return TrapState(positions, count, highest), ratio < settings.threshold, ratio


def regrasped(state: TrapState, settings: TrapSettings) -> TrapState:
    """The state after a regrasp: an empty window and, unless it is kept, no largest change."""
    highest = state.highest if settings.keeps_highest else jnp.asarray(settings.least, state.highest.dtype)
    return TrapState(state.positions, jnp.zeros_like(state.count), highest)
