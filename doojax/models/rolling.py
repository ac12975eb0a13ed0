"""What dynamics predict along many actions."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.models.protocols import Dynamics


def roll_out(
    dynamics: Dynamics, obstacles: Any, state: Any, actions: Float[Array, "T ..."]
) -> tuple[Any, Float[Array, "T"]]:
    """T steps, each from the state that the last one predicted: what a planner does.

    Args:
        dynamics: any, of one element.
        obstacles: one set [M]; None for dynamics that do not look at it.
        state: one, where to begin.
        actions: one a step.

    Returns:
        the T + 1 states, the first of which is given, and the uncertainty of each step.
    """

    def step(state: Any, action: Array) -> tuple[Any, tuple[Any, Array]]:
        after, uncertainty = dynamics(obstacles, state, action)
        return after, (after, uncertainty)

    _, (states, uncertainty) = jax.lax.scan(step, state, actions)
    return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), state, states), uncertainty
