"""Outcomes that were not as predicted: what a planner must not propose again while a trial lasts.

A search trusts its models alone, so that after a plan has failed the next search would make the same plan.
What was executed says more than any model: a transition that begins, and is predicted to go on, much as one
whose outcome was another is not taken, by luck neither.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

PLACES = 32  # the last of so many count


class Outcome(NamedTuple):
    """One executed step of a plan that came out otherwise."""

    before: Float[np.ndarray, "K 3"]  # all bodies where it began, m
    change: Float[np.ndarray, "K 3"]  # what was predicted of them, m
    error: float  # root mean square over the bodies by which what happened differs from that, m


class Refuted(eqx.Module):
    """Some outcomes, in a fixed number of places M, so that more of them compile nothing anew."""

    before: Float[Array, "*b M K 3"]  # m
    change: Float[Array, "*b M K 3"]  # m
    radius: Float[Array, "*b M"]  # m, half of the error; negative for an empty place

    def forbids(self, before: Float[Array, "K 3"], after: Float[Array, "K 3"]) -> Bool[Array, ""]:
        """Are a transition's beginning and its predicted change both within the radius of any of them?"""
        change = after - before
        begins = jnp.sqrt(((self.before - before[None]) ** 2).sum(-1).mean(-1))
        goes_on = jnp.sqrt(((self.change - change[None]) ** 2).sum(-1).mean(-1))
        return ((begins <= self.radius) & (goes_on <= self.radius)).any()


def remembered(outcomes: Sequence[Outcome], bodies: int) -> Refuted:
    """The last `PLACES` of some outcomes, those of a state with so many bodies."""
    before = np.zeros((PLACES, bodies, 3), np.float32)
    change, radius = np.zeros_like(before), np.full(PLACES, -1.0, np.float32)
    for place, outcome in enumerate(outcomes[-PLACES:]):
        before[place], change[place], radius[place] = outcome.before, outcome.change, outcome.error / 2
    return Refuted(jnp.asarray(before), jnp.asarray(change), jnp.asarray(radius))


def refuting(
    before: Float[np.ndarray, "K 3"],
    after: Float[np.ndarray, "K 3"],
    predicted: Float[np.ndarray, "2 K 3"],
    threshold: float,
) -> Outcome | None:
    """An executed step as an outcome, if it differs from what was predicted of it by more than ``threshold``.

    Changes are compared, not places: what a plan was off by before the step is not this step's fault.

    Args:
        before: all bodies when the step began, m.
        after: when it was over.
        predicted: where the plan had them, before and after it.
        threshold: m, root mean square over the bodies.
    """
    change = predicted[1] - predicted[0]
    error = float(np.sqrt(((after - before - change) ** 2).sum(-1).mean()))
    return Outcome(before, change, error) if error > threshold else None
