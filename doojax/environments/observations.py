"""What a policy sees of a task, and what its numbers from -1 to 1 command: one vector each."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.actions import ActionSpace
from doojax.geometry.sdf import signed_distances
from doojax.goals import Goal
from doojax.keys import numbered, stream
from doojax.tasks.base import Task
from doojax.types import Obstacles

NEAR = 0.5  # m, beyond which an obstacle counts as so far
DRAWN = 16  # random actions that show which coordinates a task uses


def features(task: Task, obstacles: Obstacles, state: Any, goal: Goal) -> Float[Array, "D"]:
    """One observation, metres.

    All bodies' places; how far each is from obstacles, at most `NEAR`; and from each target's nearest body
    that may reach it, the way to the target.

    Args:
        task: whose state it is.
        obstacles: one set.
        state: a `doojax.types.State`.
        goal: with T targets; D = 4 K + 3 T for K bodies.
    """
    bodies = state.bodies()
    clearance = jnp.full(len(bodies), NEAR, bodies.dtype)
    if obstacles.kind.size:
        clearance = jnp.clip(signed_distances(obstacles, bodies).min(-1), -NEAR, NEAR)
    ways = goal.targets[:, None] - bodies
    lengths = jnp.where(goal.bodies, jnp.linalg.norm(ways, axis=-1), jnp.inf)
    nearest = jnp.take_along_axis(ways, jnp.argmin(lengths, axis=-1)[:, None, None], axis=1)
    return jnp.concatenate([bodies.reshape(-1), clearance, nearest.reshape(-1)])


def used(space: ActionSpace) -> Bool[np.ndarray, "..."]:
    """Which coordinates of an action random data ever move: in a plane not the height."""
    with jax.ensure_compile_time_eval():
        drawn = jax.vmap(space.draw)(numbered(stream(0, "shape"), range(DRAWN)))
        return np.asarray((drawn != 0).any(0))


def action_size(space: ActionSpace) -> int:
    """How many numbers an action is."""
    return int(used(space).sum())


def command(space: ActionSpace, numbers: Float[Array, "U"]) -> Float[Array, "..."]:
    """The action that U numbers stand for: each from -1 to 1, of the longest move along an axis.

    There is a number for each coordinate that is `used`; the others are zero. What is longer than the space
    allows is shortened to that.
    """
    moving = used(space)
    action = jnp.zeros(moving.shape, numbers.dtype).at[np.nonzero(moving)].set(jnp.clip(numbers, -1.0, 1.0))
    action = space.longest * action
    length = jnp.linalg.norm(action, axis=-1, keepdims=True)
    return action * jnp.minimum(1.0, space.longest / jnp.maximum(length, 1e-9))


def taken(task: Task, state: Any, numbers: Float[Array, "U"]) -> Float[Array, "..."]:
    """The action that is taken where U numbers are given: what they command, or if invalid a retreat."""
    wanted = command(task.actions, numbers)
    return jnp.where(task.actions.valid(state, wanted), wanted, task.actions.retreat(state))
