"""A rope of one's own that two free hands hold by its ends, among obstacles of one's own."""

from dataclasses import dataclass, replace
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.actions import first_valid
from doojax.geometry.frames import quaternion_from_yaw, rotate
from doojax.geometry.sdf import signed_distance
from doojax.goals import Goal
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, SolverSettings, obstacles_at
from doojax.tasks.base import Box, Phase, check_phase
from doojax.tasks.grippers import GripperMoves, RopeTask, point_goal
from doojax.tasks.starts import CLEARANCE, Place
from doojax.types import Obstacles

BANK = 64  # settled ropes to start from
GAP = (0.25, 0.9)  # between the hands of a settled rope, as fractions of its length
MOST_APART = 0.97  # of the rope's length
TRIES = 64  # of where a rope starts, among what always stands alike


def two_hands_scene(
    name: str,
    rope: RopeParameters,
    obstacles: tuple[Obstacle, ...],
    *,
    links: int = 25,
    hand_radius: float = 0.01,
    max_force: float = 5.0,
    max_speed: float = 0.15,
    timestep: float = 0.005,
    control_period: float = 0.9,
    viscosity: float = 0.15,
) -> Scene:
    """A capsule chain whose first end hand 0 holds, and hand 1 its last; both let it turn.

    Args:
        name: of the scene.
        rope: what it is made of, see `RopeParameters.of_material`.
        obstacles: see `doojax.simulation.scenes.Obstacle` and `doojax.simulation.meshes.mesh_obstacle`.
        links: that the rope is cut into; errors go with one over their number.
        hand_radius: m, of each hand; it collides.
        max_force: N, of each hand.
        max_speed: m/s, of each hand.
        timestep: s; where it is too long for the rope, simulating says how long it may be.
        control_period: s of physics for each action.
        viscosity: Pa s, of the medium: drag that stands for all that calms a swinging rope.

    Raises:
        ValueError: two obstacles have one name.
    """
    names = [obstacle.name for obstacle in obstacles]
    if len(set(names)) < len(names):
        raise ValueError(f"the obstacles are called {', '.join(names)}: expected each name once")
    hold = partial(Gripper, radius=hand_radius, max_force=max_force, max_speed=max_speed)
    return Scene(
        name=name,
        rope_model=RopeModel("capsule_chain", links),
        rope=rope,
        grippers=(hold(link=0, end=-1), hold(link=links - 1, end=1)),
        obstacles=obstacles,
        timestep=timestep,
        substeps=max(round(control_period / timestep), 1),
        viscosity=viscosity,
        solver=SolverSettings(contact_time=max(0.01, 2 * timestep)),
    )


@dataclass(frozen=True)
class TwoHands(RopeTask):
    """A rope between two hands is to bring one of its points within a distance of a goal.

    Starts are ropes that hang from both hands somewhere in their reach, at rest, clear of every obstacle that
    always stands alike; the others are drawn around them. To make it known to every command::

        TASK = TwoHands("hose", scene, places, hands, goals, goal_point=12)

        [project.entry-points."doojax.tasks"]      # in the pyproject.toml of your package
        hose = "my_package:TASK.made"
    """

    name: str
    scene: Scene
    places: tuple[Place, ...]  # of each of the scene's obstacles
    hands: Box  # where they may be sent, m
    goals: Box  # in which goals are drawn, m
    goal_point: int  # the rope's point that is to reach them
    phase: Phase = "constrained"
    goal_threshold: float = 0.05  # m
    longest: float = 0.1  # m, of each hand's displacement in one action
    trajectory_states: int = 20
    grippers: int = 2

    def __post_init__(self):
        """Refuse a point that the rope lacks, and places that do not go with the obstacles."""
        if not 0 <= self.goal_point < self.scene.links:
            raise ValueError(
                f"goal_point is {self.goal_point}, expected one of the points 0 to {self.scene.links - 1}"
            )
        if len(self.scene.grippers) != 2 or self.scene.planar:
            raise ValueError(
                f"scene {self.scene.name!r} has {len(self.scene.grippers)} hands"
                f"{' and a planar rope' if self.scene.planar else ''}: expected one of two_hands_scene"
            )
        if len(self.places) != len(self.scene.obstacles):
            names = ", ".join(obstacle.name for obstacle in self.scene.obstacles) or "none"
            raise ValueError(
                f"there are {len(self.places)} places for the obstacles {names}: expected one for each"
            )

    def made(self, phase: Phase = "constrained", crowd: int = 1) -> "TwoHands":
        """The task in a phase: a factory for `doojax.tasks.register` and entry points.

        Raises:
            ValueError: a crowd of more than 1: the obstacles are what they are.
        """
        if crowd != 1:
            raise ValueError(
                f"{self.name} has its own obstacles and no crowd of {crowd} times as many: give 1"
            )
        return replace(self, phase=phase)

    @property
    def workspace(self) -> Box:
        """Where a rope can be whose hands are in reach: no farther from one than half its length."""
        half = self.scene.rope_part.parameters.length / 2
        low, high = np.array(self.hands.low) - half, np.array(self.hands.high) + half
        low[2] = max(low[2], 0.0) if self.scene.floor else low[2]
        return Box((*low.tolist(),), (*high.tolist(),))

    @property
    def actions(self) -> GripperMoves:
        """Displacements of each hand, within reach and no farther apart than the rope allows."""
        most_apart = MOST_APART * self.scene.rope_part.parameters.length
        return GripperMoves(self.longest, self.hands, self.grippers, most_apart)

    @cached_property
    def _bank(self):
        from doojax.tasks.starts import hung_bank

        random = np.random.default_rng(0)
        gap = random.uniform(*GAP, BANK) * self.scene.rope_part.parameters.length
        return hung_bank(self.scene, gap, random.uniform(-0.5, 0.5, BANK))

    def start(self):
        """The function that draws a start from a key."""
        from doojax.tasks.starts import RandomStart, placements_of

        check_phase(self.phase)
        constrained = self.phase == "constrained"
        return RandomStart(
            self._bank,
            scene=self.scene,
            place_rope=partial(_place_rope, self.scene, self.places if constrained else (), self.hands),
            placements=placements_of(self.scene, self.places) if constrained else None,
        )

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Goal:
        """A place for the task's point, farther from every obstacle than the threshold."""

        def clear(goal):
            return signed_distance(obstacles, goal) > self.goal_threshold

        middle = (jnp.array(self.goals.low) + jnp.array(self.goals.high)) / 2
        return point_goal(self, first_valid(key, self.goals.sample, clear, fallback=middle))


def _place_rope(
    scene: Scene, places: tuple[Place, ...], reach: Box, key: Array, points: Float[Array, "P 3"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """A move and a turn that bring both hands in reach, clear of what always stands alike."""
    from doojax.tasks.starts import placed_within

    radius = max(scene.rope_part.parameters.radius, *(hand.radius for hand in scene.grippers))
    lowest = radius + CLEARANCE if scene.floor else -np.inf
    moves, yaws = jax.vmap(lambda own: placed_within(reach, lowest, own, points))(
        jax.random.split(key, TRIES)
    )
    standing = [index for index, place in enumerate(places) if place.fixed]
    if not standing:
        return moves[0], yaws[0]
    here = replace(scene, obstacles=tuple(scene.obstacles[index] for index in standing))
    position = jnp.array([places[index].position for index in standing])
    turned = jax.vmap(quaternion_from_yaw)(jnp.array([places[index].yaw[0] for index in standing]))
    obstacles = obstacles_at(here, position, turned)

    def clear(move, yaw):
        there = rotate(quaternion_from_yaw(yaw), points) + move
        return signed_distance(obstacles, there).min() > radius + CLEARANCE

    first = jnp.argmax(jax.vmap(clear)(moves, yaws))
    return moves[first], yaws[first]
