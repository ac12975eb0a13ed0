"""What a task is: a scene, and how its starts, obstacles, actions and goals are drawn.

A task knows no planner and no learner. Every sampler is a pure function of one element.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, get_args, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from doojax.types import Obstacles, RopeState

if TYPE_CHECKING:
    from doojax.simulation.scenes import Scene
    from doojax.simulation.state import Simulator

Phase = Literal["unconstrained", "constrained"]
"""Phase one: no obstacles, nothing overstretched. Phase two: everything that can get in the way."""

CANDIDATES = 32  # tried at once where a sample may be invalid
REPEAT_PROBABILITY = 0.8  # of the previous action


@dataclass(frozen=True)
class Box:
    """An axis-aligned region, metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def sample(self, key: Array) -> Float[Array, "3"]:
        """A uniform point."""
        return jax.random.uniform(key, (3,), minval=jnp.array(self.low), maxval=jnp.array(self.high))

    def contains(self, points: Float[Array, "*b 3"]) -> Bool[Array, "*b"]:
        """Is each point inside?"""
        return ((points >= jnp.array(self.low)) & (points <= jnp.array(self.high))).all(-1)

    def clip(self, points: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
        """The nearest point inside."""
        return jnp.clip(points, jnp.array(self.low), jnp.array(self.high))


@runtime_checkable
class Task(Protocol):
    """A manipulation problem; `make_task` builds one by name."""

    @property
    def name(self) -> str:
        """The name that `make_task` knows it by."""
        ...

    @property
    def scene(self) -> "Scene":
        """What is simulated; the same in both phases, because obstacles are data."""
        ...

    @property
    def trajectory_states(self) -> dict[str, int]:
        """States of a trajectory in the thesis's data, by phase."""
        ...

    @property
    def grippers(self) -> int:
        """How many grippers move the rope."""
        ...

    def simulator(self, engine: str = "auto", phase: Phase = "constrained") -> "Simulator":
        """The task's scene on an engine: mujoco, mjx, warp, or auto (the fastest on this machine)."""
        ...

    def sample_action(
        self, key: Array, state: RopeState, previous: Float[Array, "G 3"], phase: Phase
    ) -> Float[Array, "G 3"]:
        """Gripper displacements (m): often ``previous`` again; zeros as ``previous`` ask for a fresh one."""
        ...

    def draw_action(self, key: Array) -> Float[Array, "G 3"]:
        """Gripper displacements (m) of the distribution from which `sample_action` takes the valid ones."""
        ...

    def valid_action(self, state: RopeState, action: Float[Array, "G 3"], phase: Phase) -> Bool[Array, ""]:
        """May the grippers be sent there? An action longer than any that is drawn may not be taken."""
        ...

    def retreat(self, state: RopeState, phase: Phase) -> Float[Array, "G 3"]:
        """The action (m) that leads back to where others are valid."""
        ...

    @property
    def workspace(self) -> Box:
        """Where rope and grippers can be, and so every goal, metres."""
        ...

    @property
    def goal_point(self) -> int:
        """Index of the rope's point that is to reach the goal."""
        ...

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Float[Array, "3"]:
        """A point (m) for the task's rope point to reach, clear of the obstacles."""
        ...

    def goal_distance(self, state: RopeState, goal: Float[Array, "3"]) -> Float[Array, ""]:
        """Metres between the task's rope point and ``goal``."""
        ...

    @property
    def goal_threshold(self) -> float:
        """Metres within which a goal counts as reached."""
        ...


def first_valid(
    key: Array, draw: Callable[[Array], Array], valid: Callable[[Array], Bool[Array, ""]], fallback: Array
) -> Array:
    """The first of `CANDIDATES` draws that is valid, else ``fallback``: rejection with a bounded cost."""
    candidates = jax.vmap(draw)(jax.random.split(key, CANDIDATES))
    accepted = jax.vmap(valid)(candidates)
    return jnp.where(accepted.any(), candidates[jnp.argmax(accepted)], fallback)


def short_enough(action: Float[Array, "G 3"], longest: float) -> Bool[Array, ""]:
    """Is every gripper's displacement at most ``longest`` (m), but for rounding?"""
    return (jnp.linalg.norm(action, axis=-1) <= (1 + 1e-5) * longest).all()


def repeated_or_drawn(
    task: Task, key: Array, state: RopeState, previous: Float[Array, "G 3"], phase: Phase
) -> Float[Array, "G 3"]:
    """``previous`` with probability 0.8 if it is valid and not zero, else the first valid one drawn anew.

    Where none of those drawn is valid, the task's retreat.
    """
    repeat_key, draw_key = jax.random.split(key)
    repeat = (jax.random.uniform(repeat_key) < REPEAT_PROBABILITY) & (previous != 0).any()

    def valid(action):
        return task.valid_action(state, action, phase)

    fresh = first_valid(draw_key, task.draw_action, valid, fallback=task.retreat(state, phase))
    return jnp.where(repeat & valid(previous), previous, fresh)


def planar_action(key: Array, longest: float) -> Float[Array, "1 3"]:
    """One gripper's displacement in the plane: uniform in direction, and in length up to ``longest`` (m)."""
    angle_key, length_key = jax.random.split(key)
    angle = jax.random.uniform(angle_key, minval=-jnp.pi, maxval=jnp.pi)
    length = jax.random.uniform(length_key, maxval=longest)
    return length * jnp.array([[jnp.cos(angle), jnp.sin(angle), 0.0]])


def check_phase(phase: str) -> None:
    """Raise ValueError for an unknown phase."""
    if phase not in get_args(Phase):
        raise ValueError(f"unknown phase {phase!r}, expected one of {', '.join(get_args(Phase))}")
