"""Goals in state space: places for points of the rope, for grippers, for any of several, for all at once."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.modules import Jittable
from doojax.tasks.base import Task
from doojax.types import RopeState

BEYOND = 1e3  # m, from a target to a body that does not count for it


class Goal(Jittable):
    """K targets, each to be reached by one of some bodies: the rope's N points, then the G grippers."""

    targets: Float[Array, "*b K 3"]  # world frame, metres
    bodies: Bool[Array, "*b K NG"]  # which of the N + G bodies may reach each target
    tolerance: Float[Array, "*b"]  # m, within which the goal counts as reached

    def distance(self, state: RopeState) -> Float[Array, ""]:
        """Metres that are missing: of each target's nearest body, the farthest."""
        distances = jnp.linalg.norm(self.targets[:, None] - bodies_of(state), axis=-1)
        return jnp.where(self.bodies, distances, BEYOND).min(-1).max()


def bodies_of(state: RopeState) -> Float[Array, "*b NG 3"]:
    """The rope's points and then the grippers, metres."""
    return jnp.concatenate([state.points, state.grippers], axis=-2)


def point_goal(task: Task, position: Float[Array, "3"], *, points: Sequence[int] | None = None) -> Goal:
    """A point of the rope at ``position`` (m); the task's own point if none is named, else any of ``points``.

    Raises:
        ValueError: for an index that the rope lacks.
    """
    links = task.scene.links
    chosen = [task.goal_point] if points is None else list(points)
    if not chosen or not all(0 <= index < links for index in chosen):
        raise ValueError(f"points are {chosen}, expected some of the rope's points 0 to {links - 1}")
    return _goal(task, [position], [chosen])


def gripper_goal(task: Task, positions: Float[Array, "G 3"]) -> Goal:
    """Every gripper at its position (m).

    Raises:
        ValueError: for another number of positions than of grippers.
    """
    if len(positions) != task.grippers:
        raise ValueError(f"there are {len(positions)} positions for {task.grippers} grippers")
    links = task.scene.links
    return _goal(task, list(positions), [[links + g] for g in range(task.grippers)])


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


def _goal(task: Task, targets: Sequence[Array], bodies: Sequence[Sequence[int]]) -> Goal:
    mask = np.zeros((len(targets), task.scene.links + task.grippers), dtype=bool)
    for row, chosen in enumerate(bodies):
        mask[row, list(chosen)] = True
    return Goal(
        targets=jnp.stack([jnp.asarray(target, dtype=jnp.float32) for target in targets]),
        bodies=jnp.asarray(mask),
        tolerance=jnp.asarray(task.goal_threshold, dtype=jnp.float32),
    )
