"""Water a plant: pour at least 75 % into its pot, spill less than 5 % (thesis section 4.4.2).

The phase unconstrained is the source: no plant, a wide container. The phase constrained is the target: a
plant in the receiver, three times the viscosity, a narrower container. Distances are those of the thesis's
released code; its particles, which overlap there, are made as small as they must be to fit.
"""

from dataclasses import dataclass, field, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.box import Box
from doojax.goals import Goal, goal_of
from doojax.modules import Jittable
from doojax.simulation.fluid.containers import Container
from doojax.simulation.fluid.pouring import PouringScene, PouringSimulator, start_at
from doojax.simulation.fluid.settings import FluidSettings
from doojax.simulation.scenes import Obstacle, Shape, parked_poses
from doojax.simulation.state import SimState
from doojax.tasks.base import Phase, check_phase
from doojax.types import GAUGES, WHOLE, Obstacles, PouringState, ShapeKind

RECEIVER = Container(0.351, 0.389, 0.100)
RECEIVER_PLACE = (0.5, 0.0, 0.02)  # m, of its inner floor
WIDE, NARROW = Container(0.191, 0.209, 0.130), Container(0.101, 0.149, 0.130)
VISCOSITY, THICKER = 8e-4, 3.0  # m^2/s, and how many times that in the target
STEM = ((0.45, -0.03, 0.02), (0.58, 0.03, 0.45))  # m, lowest and highest corner
CANOPY = ((0.15, -0.5, 0.45), (0.58, 0.5, 0.73))
WORKSPACE = Box((-0.1, -0.01, 0.03), (0.6, 0.01, 1.05))  # of the container's place, m
MOVE, SHORTEST = 0.18, 0.08  # m, along x or z; and at least in all
POUR = (2.0, 3.1)  # rad
UPRIGHT = 0.05  # rad, below which nothing is poured
REACH_PLANNED, REACH_COLLECTED = 0.25, 0.20  # m, from the receiver's left edge along x, where it is poured
ABOVE = 0.02  # m, over the receiver's rim
START, SPREAD = (-0.07, 0.30), (0.02, 0.05)  # m, x and z of the container
EVERYTHING = Box((-0.2, -1.3, 0.0), (0.8, 0.5, 1.6))  # m, in which all bodies are, gauges included
AT_LEAST, ROOM = 0.875, 0.125  # poured: the middle of what is enough, and half of its width
REGION = Box((-0.7, -0.6, -0.1), (1.3, 0.6, 1.4))  # in which neighbours are looked up fast


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Shape:
    """A box from corner to corner, m."""
    half = tuple((b - a) / 2 for a, b in zip(low, high, strict=True))
    middle = tuple((b + a) / 2 for a, b in zip(low, high, strict=True))
    return Shape(ShapeKind.BOX, (half[0], half[1], half[2]), (middle[0], middle[1], middle[2]))


def default_scene(phase: Phase, dimensions: int = 3) -> PouringScene:
    """510 particles in space, or 100 in the plane."""
    walls = zip(RECEIVER.half_sizes.tolist(), RECEIVER.centres.tolist(), strict=True)
    receiver = tuple(Shape(ShapeKind.BOX, tuple(half), tuple(centre)) for half, centre in walls)
    target = phase == "constrained"
    fluid = FluidSettings(viscosity=VISCOSITY * (THICKER if target else 1.0), region=REGION)
    if dimensions == 2:
        fluid = replace(fluid, spacing=0.0085, dimensions=2)
    else:
        fluid = replace(fluid, spacing=0.0132)
    return PouringScene(
        name="watering" if dimensions == 3 else "watering_2d",
        container=NARROW if target else WIDE,
        receiver=RECEIVER,
        obstacles=(Obstacle("receiver", receiver), Obstacle("plant", (box(*STEM), box(*CANOPY)))),
        fluid=fluid,
        particles=510 if dimensions == 3 else 100,
    )


class WateringStart(Jittable):
    """Draws where the container is at first: left of the receiver, clear of everything."""

    scene: PouringScene = eqx.field(static=True)
    phase: Phase = eqx.field(static=True)

    def __call__(self, key: Array) -> SimState:
        """A start; the receiver stands in its place, and the plant in it or far away."""
        draw = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        x, z = (middle + spread * one for middle, spread, one in zip(START, SPREAD, draw, strict=True))
        position, quaternion = parked_poses(2)
        here = 2 if self.phase == "constrained" else 1
        position = position.at[:here].set(jnp.array([RECEIVER_PLACE, (0.0, 0.0, 0.0)])[:here])
        quaternion = quaternion.at[:here].set(jnp.array([1.0, 0.0, 0.0, 0.0]))
        return start_at(self.scene, x, z, position, quaternion)

    def __hash__(self) -> int:
        return hash((self.scene, self.phase))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, WateringStart) and (self.scene, self.phase) == (other.scene, other.phase)


@dataclass(frozen=True)
class Pours:
    """Where the container is carried (x and z, m) and to which angle it is turned (rad), as [1, 3].

    Three kinds are drawn: it is carried anywhere, upright; it is carried to where it can pour; it is tilted.
    """

    longest: float = 3.2
    repeats: float = 0.0

    def draw(self, key: Array) -> Float[Array, "1 3"]:
        """Half of them pour, the others go up to 18 cm along x and z, and turn it upright."""
        kind_key, move_key, angle_key = jax.random.split(key, 3)
        move = jax.random.uniform(move_key, (2,), minval=-MOVE, maxval=MOVE)
        angle = jax.random.uniform(angle_key, minval=POUR[0], maxval=POUR[1])
        pours = jax.random.uniform(kind_key) < 0.5
        return jnp.where(pours, jnp.append(jnp.zeros(2), angle), jnp.append(move, 0.0))[None]

    def draw_in(self, key: Array, state: PouringState) -> Float[Array, "1 3"]:
        """For data: anywhere, over the receiver or tilted, 20, 10 and 70 of 100 where it can pour, else 30
        and 70 of the first two."""
        kind_key, move_key, over_key, angle_key = jax.random.split(key, 4)
        can = self.can_pour(state, REACH_COLLECTED)
        kind = jax.random.uniform(kind_key)
        anywhere = jax.random.uniform(
            move_key, (2,), minval=jnp.array(WORKSPACE.low)[::2], maxval=jnp.array(WORKSPACE.high)[::2]
        )
        here = state.container[::2]
        edge = jnp.stack([_edge(state), state.receiver[2] + RECEIVER.height + 0.15])
        over = edge + jax.random.uniform(over_key, (2,), minval=-0.1, maxval=0.1)
        angle = jax.random.uniform(angle_key, minval=POUR[0], maxval=POUR[1])
        free = kind < jnp.where(can, 0.2, 0.3)
        tilt = can & (kind >= 0.3)
        carried = jnp.where(free, anywhere, over) - here
        return jnp.where(tilt, jnp.append(jnp.zeros(2), angle), jnp.append(carried, 0.0))[None]

    def can_pour(self, state: PouringState, reach: float = REACH_PLANNED) -> Bool[Array, ""]:
        """Is it above the receiver's rim, and near its left edge?"""
        high = state.container[2] >= state.receiver[2] + RECEIVER.height + ABOVE
        return high & (jnp.abs(state.container[0] - _edge(state)) <= reach)

    def valid(self, state: PouringState, action: Float[Array, "1 3"]) -> Bool[Array, ""]:
        """Is its target in the workspace, its move none of the shortest; and where it tilts, can it pour?"""
        move, angle = action[0, :2], action[0, 2]
        target = state.container + jnp.stack([move[0], jnp.zeros(()), move[1]])
        length = jnp.sqrt((move**2).sum())
        tilted = angle > UPRIGHT
        pours = self.can_pour(state) & (length < 1e-6) & (angle <= jnp.pi)
        moves = (length >= SHORTEST) | (state.angle > UPRIGHT)
        return WORKSPACE.contains(target) & jnp.where(tilted, pours, moves & (angle >= -UPRIGHT))

    def retreat(self, state: PouringState) -> Float[Array, "1 3"]:
        """Upright, into the workspace."""
        way = WORKSPACE.clip(state.container) - state.container
        return jnp.stack([way[0], way[2], jnp.zeros(())])[None]

    def missing(
        self, state: PouringState, action: Float[Array, "1 3"], aim: Float[Array, "7 3"]
    ) -> Float[Array, ""]:
        """Square metres between the container's corners where it is sent and those of ``aim``."""
        place = state.container + jnp.stack([action[0, 0], jnp.zeros(()), action[0, 1]])
        there = PouringState(place, action[0, 2], state.receiver, state.volumes, state.size)
        return ((there.bodies()[3:] - aim[3:]) ** 2).sum()

    def between(self, state: PouringState, later: PouringState, steps: int) -> Float[Array, "*b 1 3"]:
        """The straight way in so many equal moves, and the last angle."""
        way = (later.container - state.container)[..., ::2] / max(steps, 1)
        return jnp.concatenate([way, later.angle[..., None]], axis=-1)[..., None, :]


@dataclass(frozen=True)
class Watering:
    """One container; its goal is a level of each of the two gauges of `PouringState`."""

    name: str = "watering"
    phase: Phase = "constrained"
    grippers: int = 1
    goal_threshold: float = ROOM * WHOLE
    goal_point: int = 0
    trajectory_states: int = 7
    actions: Pours = Pours()
    workspace: Box = EVERYTHING
    scene: PouringScene = field(default_factory=lambda: default_scene("constrained"))

    @classmethod
    def of(cls, phase: Phase, crowd: int) -> "Watering":
        """The task in a phase, in space.

        Raises:
            ValueError: for another crowd than 1.
        """
        return _made("watering", phase, crowd, 3)

    @classmethod
    def flat(cls, phase: Phase, crowd: int) -> "Watering":
        """The same in the plane, with fewer particles."""
        return _made("watering_2d", phase, crowd, 2)

    @property
    def blank(self) -> PouringState:
        """A state of zeros."""
        return PouringState(jnp.zeros(3), jnp.zeros(()), jnp.zeros(3), jnp.zeros(2), jnp.zeros(2))

    def simulator(self, engine: str = "auto") -> PouringSimulator:
        """The fluid in pure JAX, whatever the engine."""
        return PouringSimulator(self.scene, WateringStart(self.scene, self.phase))

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Goal:
        """At least 75 % poured and at most 5 % spilled: the goal of every scene."""
        base = jnp.array(RECEIVER_PLACE)
        enough = base + jnp.array(GAUGES[0]) + jnp.array([0.0, 0.0, AT_LEAST * WHOLE])
        nothing = base + jnp.array(GAUGES[1])
        return goal_of([enough, nothing], [[0], [1]], 7, self.goal_threshold)

    def reach(self) -> Float[np.ndarray, "7 7"]:
        """Nothing holds the bodies together."""
        return np.where(np.eye(7, dtype=bool), 0.0, np.inf)

    def sample(
        self,
        key: Array,
        workspace: Box,
        shape: Float[Array, "7 3"],
        goal: Goal,
        towards_goal: Bool[Array, ""],
    ) -> Float[Array, "7 3"]:
        """A container anywhere that it can be, upright or pouring, and gauges anywhere or at the goal: a
        `doojax.planning.metric.Sampler`."""
        draws = jax.random.uniform(key, (5,))
        low, high = jnp.array(WORKSPACE.low), jnp.array(WORKSPACE.high)
        place = low + (high - low) * draws[:3]
        angle = jnp.where(draws[3] < 0.5, 0.0, POUR[0] + (POUR[1] - POUR[0]) * 2 * (draws[3] - 0.5))
        width = jnp.sqrt(((shape[4] - shape[3]) ** 2).sum())
        height = jnp.sqrt(((shape[5] - shape[3]) ** 2).sum())
        volumes = jnp.stack([draws[4], 1 - draws[4]])
        somewhere = PouringState(
            place, angle, jnp.array(RECEIVER_PLACE), volumes, jnp.stack([width, height])
        ).bodies()
        return jnp.where(towards_goal, somewhere.at[:2].set(goal.targets[:2]), somewhere)


def _made(name: str, phase: Phase, crowd: int, dimensions: int) -> Watering:
    check_phase(phase)
    if crowd != 1:
        raise ValueError(f"crowd is {crowd}, but {name} has one receiver and one plant only")
    return Watering(name=name, phase=phase, scene=default_scene(phase, dimensions))


def _edge(state: PouringState) -> Float[Array, ""]:
    """x of the receiver's left edge, m."""
    return state.receiver[0] - RECEIVER.width / 2 - RECEIVER.wall
