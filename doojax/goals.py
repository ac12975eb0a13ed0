"""Goals in state space: places for bodies, for any of several, for all at once."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.modules import Jittable
from doojax.types import State

BEYOND = 1e3  # m, from a target to a body that does not count for it


class Goal(Jittable):
    """T targets, each to be reached by one of some of a state's K bodies, see `doojax.types.State`."""

    targets: Float[Array, "*b T 3"]  # world frame, metres
    bodies: Bool[Array, "*b T K"]  # which of the bodies may reach each target
    tolerance: Float[Array, "*b"]  # m, within which the goal counts as reached

    def distance(self, state: State) -> Float[Array, ""]:
        """Metres that are missing: of each target's nearest body, the farthest."""
        distances = jnp.linalg.norm(self.targets[:, None] - state.bodies(), axis=-1)
        return jnp.where(self.bodies, distances, BEYOND).min(-1).max()


def goal_of(
    targets: Sequence[Float[Array, "3"]], bodies: Sequence[Sequence[int]], count: int, tolerance: float
) -> Goal:
    """A goal for bodies by their numbers.

    Args:
        targets: places (m), at least one.
        bodies: for each target the numbers of those that may reach it.
        count: of all bodies of a state.
        tolerance: m.

    Raises:
        ValueError: for a body that there is not, or a target that none may reach.
    """
    mask = np.zeros((len(targets), count), dtype=bool)
    for row, chosen in enumerate(bodies):
        if not chosen or not all(0 <= index < count for index in chosen):
            raise ValueError(f"bodies are {list(chosen)}, expected some of 0 to {count - 1}")
        mask[row, list(chosen)] = True
    return Goal(
        targets=jnp.stack([jnp.asarray(target, dtype=jnp.float32) for target in targets]),
        bodies=jnp.asarray(mask),
        tolerance=jnp.asarray(tolerance, dtype=jnp.float32),
    )


def all_of(*goals: Goal) -> Goal:
    """Every one of some goals; the tightest tolerance counts for all.

    Raises:
        ValueError: for no goals.
    """
    if not goals:
        raise ValueError("all_of needs at least one goal")
    return Goal(
        targets=jnp.concatenate([goal.targets for goal in goals]),
        bodies=jnp.concatenate([goal.bodies for goal in goals]),
        tolerance=jnp.stack([goal.tolerance for goal in goals]).min(),
    )
