"""What trajectories cost in MPPI: the terms of the thesis's equation 5.2 and of its released code.

Terms that look at a state are functions of what they need of it; `summed` and `final` make a
`doojax.planning.mppi.Term` of a function of state and control. Weights are the caller's; those of the
released code are `THESIS_WEIGHTS`.
"""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from doojax.geometry.frames import safe_norm
from doojax.planning.mppi import Term

THESIS_WEIGHTS = MappingProxyType(
    {
        "reaching": 1.0,  # metres
        "hands_reaching": 1.0,  # alpha_1
        "contacts": 3.0,  # alpha_2
        "smoothness": 0.02,  # alpha_3
        "finger": 0.5,
        "grasping": 1.0,
        "rope_touched": 1.5,  # `contacts` of a hand that holds nothing with the rope
        "rope_near": 0.3,
        "unstable": 100.0,
        "torn": 100.0,
    }
)


def summed(cost: Callable[[Any, Float[Array, "U"]], Float[Array, ""]]) -> Term:
    """The sum of ``cost(state, control)`` over a trajectory, of each state and the control before it."""
    return lambda states, controls: jax.vmap(cost)(states, controls).sum()


def final(cost: Callable[[Any], Float[Array, ""]]) -> Term:
    """``cost(state)`` of the last state."""
    return lambda states, controls: cost(jax.tree.map(lambda leaf: leaf[-1], states))


def weighted(weight: float, term: Term) -> Term:
    """``weight`` times a term."""
    return lambda states, controls: weight * term(states, controls)


def smoothness(states: Any, controls: Float[Array, "H U"]) -> Float[Array, ""]:
    """A term: the lengths of the steps from each control to the next, as the released code has it.

    Equation 5.2 says the length of the controls themselves.
    """
    steps = controls[1:] - controls[:-1]
    return safe_norm(*jnp.moveaxis(steps, -1, 0)).sum()


def reaching(point: Float[Array, "3"], goal: Float[Array, "3"]) -> Float[Array, ""]:
    """Metres between a point and where it is to be."""
    return safe_norm(*(point - goal))


def hands_reaching(
    hands: Float[Array, "G 3"], holding: Bool[Array, "G"], goal: Float[Array, "3"]
) -> Float[Array, ""]:
    """Metres from the goal to each hand that holds the rope, summed: what pulls a slack rope taut."""
    return jnp.where(holding, safe_norm(*(hands - goal).T), 0).sum()


def contacts(count: Int[Array, ""] | Float[Array, ""], most: int = 6) -> Float[Array, ""]:
    """Root of the number of contacts, as a fraction of that of ``most``, from which on more cost nothing."""
    return jnp.minimum(jnp.sqrt(count / most), 1.0)


def closeness(distance: Float[Array, ""], margin: float) -> Float[Array, ""]:
    """The same from an exact distance (m), smooth: 0 from ``margin`` on, 1 at touch, and on rising inside."""
    return jnp.maximum(1 - distance / margin, 0) ** 2


def finger(opening: Float[Array, "G"], target: Float[Array, "G"]) -> Float[Array, ""]:
    """By how much fingers (rad) are off what holding or letting go asks of them."""
    return jnp.abs(opening - target).sum()


def grasping(
    hands: Float[Array, "G 3"], points: Float[Array, "G 3"], wanted: Bool[Array, "G"]
) -> Float[Array, ""]:
    """Metres between each hand that should hold the rope and the point of it that it should hold."""
    return jnp.where(wanted, safe_norm(*(hands - points).T), 0).sum()


def unstable(faults: Int[Array, ""]) -> Float[Array, ""]:
    """One for a state that a simulation reports any fault of."""
    return (faults != 0).astype(float)


def torn(gaps: Float[Array, "C"]) -> Float[Array, ""]:
    """Squared metres by which constraints are violated, such as the gap between a hand and what it holds."""
    return (gaps**2).sum()


def rope_near(
    hands: Float[Array, "G 3"], holding: Bool[Array, "G"], rope: Float[Array, "N 3"]
) -> Float[Array, ""]:
    """Keeps hands that hold nothing some 0.32 m from the rope: of each the least abs(d^2 - 0.1 m^2)."""
    square = ((hands[:, None] - rope[None]) ** 2).sum(-1)
    return jnp.where(holding, 0, jnp.abs(square - 0.1).min(-1)).sum()
