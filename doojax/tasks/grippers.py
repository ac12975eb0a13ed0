"""Free hands that hold a rope or push something: their actions, and goals for rope and hands."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.box import Box
from doojax.goals import Goal, goal_of
from doojax.simulation.scenes import Scene
from doojax.simulation.state import SimState, Simulator
from doojax.tasks.base import Task
from doojax.types import RopeState, State


@dataclass(frozen=True)
class GripperMoves:
    """Displacements (m) of G hands, each by itself: a `doojax.actions.ActionSpace`.

    Hands are what stands behind the passive bodies of a state.

    One hand moves in the plane, uniform in direction and in length. Several move in space, each uniform in
    pitch, yaw and length (more small moves than a uniform ball has), as in the thesis's released code.
    """

    longest: float  # m, of each hand's displacement
    reach: Box  # of the hands
    grippers: int = 1
    most_apart: float = float("inf")  # m, between the first two hands
    repeats: float = 0.8  # probability of the move before, as in the released code

    def draw(self, key: Array) -> Float[Array, "G 3"]:
        """Uniform in direction, or in pitch and yaw, and in length."""
        if self.grippers == 1:
            return planar_action(key, self.longest)
        count = self.grippers
        pitch_key, yaw_key, length_key = jax.random.split(key, 3)
        pitch = jax.random.uniform(pitch_key, (count,), minval=-jnp.pi, maxval=jnp.pi)
        yaw = jax.random.uniform(yaw_key, (count,), minval=-jnp.pi, maxval=jnp.pi)
        length = jax.random.uniform(length_key, (count, 1), maxval=self.longest)
        direction = [jnp.cos(pitch) * jnp.cos(yaw), jnp.cos(pitch) * jnp.sin(yaw), jnp.sin(pitch)]
        return length * jnp.stack(direction, axis=-1)

    def valid(self, state: State, action: Float[Array, "G 3"]) -> Bool[Array, ""]:
        """Is no hand sent too far at once, out of reach, or too far from the other?"""
        target = hands(state) + action
        short = (jnp.linalg.norm(action, axis=-1) <= (1 + 1e-5) * self.longest).all()  # but for rounding
        fine = self.reach.contains(target).all() & short
        if self.grippers == 1:
            return fine
        return fine & (jnp.linalg.norm(target[0] - target[1]) < self.most_apart)

    def retreat(self, state: State) -> Float[Array, "G 3"]:
        """Into reach; several hands close in on each other there."""
        here = hands(state)
        inside = self.reach.clip(here)
        if self.grippers == 1:
            return inside - here
        closing = 0.9 * (inside - inside.mean(0)) + inside.mean(0) - here
        length = jnp.linalg.norm(closing, axis=-1, keepdims=True)
        return closing * jnp.minimum(1.0, self.longest / (length + 1e-9))

    def missing(
        self, state: State, action: Float[Array, "G 3"], aim: Float[Array, "K 3"]
    ) -> Float[Array, ""]:
        """Square metres between where the hands are sent and where ``aim`` has them, summed."""
        return ((aim[-self.grippers :] - hands(state) - action) ** 2).sum()

    def between(self, state: State, later: State, steps: int) -> Float[Array, "G 3"]:
        """The straight way of the hands in so many equal moves."""
        return (hands(later) - hands(state)) / max(steps, 1)


def hands(state: State) -> Float[Array, "G 3"]:
    """Where the hands are, metres."""
    return state.bodies()[state.passive :]


def planar_action(key: Array, longest: float) -> Float[Array, "1 3"]:
    """One hand's displacement in the plane: uniform in direction, and in length up to ``longest`` (m)."""
    angle_key, length_key = jax.random.split(key)
    angle = jax.random.uniform(angle_key, minval=-jnp.pi, maxval=jnp.pi)
    length = jax.random.uniform(length_key, maxval=longest)
    return length * jnp.array([[jnp.cos(angle), jnp.sin(angle), 0.0]])


def point_goal(task: Task, position: Float[Array, "3"], *, points: Sequence[int] | None = None) -> Goal:
    """A point of the rope at ``position`` (m); the task's own point if none is named, else any of ``points``.

    Raises:
        ValueError: for an index that the rope lacks.
    """
    links = task.scene.links
    chosen = [task.goal_point] if points is None else list(points)
    if not chosen or not all(0 <= index < links for index in chosen):
        raise ValueError(f"points are {chosen}, expected some of the rope's points 0 to {links - 1}")
    return goal_of([position], [chosen], links + task.grippers, task.goal_threshold)


def gripper_goal(task: Task, positions: Float[Array, "G 3"]) -> Goal:
    """Every gripper at its position (m).

    Raises:
        ValueError: for another number of positions than of grippers.
    """
    if len(positions) != task.grippers:
        raise ValueError(f"there are {len(positions)} positions for {task.grippers} grippers")
    links = task.scene.links
    bodies = [[links + g] for g in range(task.grippers)]
    return goal_of(list(positions), bodies, links + task.grippers, task.goal_threshold)


class RopeTask:
    """What tasks of a rope that hands hold have in common: their states, and how far apart bodies can get."""

    scene: Scene
    grippers: int

    @property
    def blank(self) -> RopeState:
        """A state of zeros."""
        return RopeState(jnp.zeros((self.scene.links, 3)), jnp.zeros((self.grippers, 3)))

    def reach(self) -> Float[np.ndarray, "NG NG"]:
        """How long (m) the rope is between each two of its points and of what the hands hold."""
        links = self.scene.links
        held = [hand.link + hand.end / 2 for hand in self.scene.grippers if hand.link is not None]
        place = (np.array([*range(links), *held]) + 0.5) * self.scene.rope_part.parameters.length / links
        return np.abs(place[:, None] - place)

    @abstractmethod
    def start(self) -> Callable[[Array], SimState]:
        """The function that draws a start from a key."""
        ...

    def simulator(self, engine: str = "auto") -> Simulator:
        """The scene on an engine; see `Task.simulator`."""
        from doojax.simulation.engines import make_simulator

        return make_simulator(self.scene, self.start(), engine)
