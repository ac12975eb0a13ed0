"""Hold a rope by both ends over an engine bay, bring its middle under a lift tab (thesis chapter IV).

Boxes and goals are those of the released code's scene ``car_scene5``. Its goals, starts and workspace are in
the robot's frame, which stands 14.5 cm above the floor; everything here is in the world's, on the floor. They
lie as they do there: between the pallet and the tabs.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.actions import first_valid
from doojax.geometry.frames import (
    quaternion_from_rotation_vector,
    quaternion_from_yaw,
    quaternion_multiply,
    rotate,
)
from doojax.geometry.sdf import signed_distance
from doojax.goals import Goal
from doojax.modules import Jittable
from doojax.simulation.scenes import Obstacle, Scene, Shape, obstacles_at
from doojax.simulation.state import SimState, Start
from doojax.tasks.base import Box, Phase, check_phase
from doojax.tasks.grippers import GripperMoves, RopeTask, point_goal
from doojax.tasks.held_rope import MAX_ACTION, MAX_GAP, MIDPOINT, RADIUS, held_rope_scene
from doojax.tasks.ropes import OtherRope
from doojax.types import Obstacles, ShapeKind

LIFTED = 0.145  # m, from the floor to the robot's frame
BAY = ((1.22, -0.14, 0.10), 0.017, -1.5377)  # position (m), roll and yaw (rad) of the model
BOXES = (  # full sizes and centres in the model, m
    ((0.34, 0.37, 0.30), (-0.03, -0.20, 0.14)),  # the engine's body and top
    ((0.24, 0.28, 0.13), (-0.02, -0.29, 0.32)),
    ((0.10, 0.09, 0.04), (0.12, -0.07, 0.18)),  # lift tabs
    ((0.10, 0.09, 0.04), (0.12, -0.32, 0.18)),
    ((0.10, 0.10, 0.07), (-0.245, -0.07, 0.18)),
    ((0.10, 0.09, 0.035), (-0.245, -0.36, 0.16)),
    *(((0.04, 0.04, 0.04), (x, y, 0.40)) for x in (0.08, -0.12) for y in (-0.17, -0.41)),  # hooks on top
    ((1.5, 1.2, 0.21), (0.0, -0.07, -0.08)),  # the pallet, and boxes on it
    ((0.20, 0.23, 0.15), (-0.13, 0.08, 0.12)),
    ((0.30, 0.35, 0.32), (0.10, 0.18, 0.20)),
    ((0.26, 0.52, 0.14), (0.37, -0.05, 0.07)),
)
TANK = ((0.105, 0.105, 0.135), (-0.53, -0.22, 0.15))  # of the cylinder: half size and centre
HOOD = ((1.5, 0.2, 1.1), (0.0, 0.3, 0.5), (0.55, 0.0, 0.0))  # and a turn: rotation vector, rad
BUMPER = (0.4, 0.12, 0.4)
BUMPERS = (
    (-0.1, -0.6, 0.0),
    (-0.41, -0.56, -0.2),
    (-0.7, -0.46, -0.5),
    (0.21, -0.56, 0.2),
    (0.5, -0.46, 0.5),
)
GOALS = tuple(  # m, under the tabs
    (x, y, z + LIFTED)
    for x, y, z in (
        (0.852, 0.088, 0.036),
        (0.903, -0.321, 0.037),
        (1.121, -0.334, 0.036),
        (1.132, 0.106, 0.036),
    )
)
AROUND = Box((-0.03, -0.03, -0.02), (0.03, 0.03, 0.02))  # those, for goals that differ
CLEAR = (0.852, 0.110, 0.036 + LIFTED)  # a goal that is at least the threshold from everything
GOAL_POINTS = tuple(range(7, 18))  # of the rope, of which any may reach the goal
HELD = (0.8, 0.0, 0.9 + LIFTED)  # m, between the hands at the fixed start
HELD_GAP = 0.4  # m
REACH = {  # of gripper targets
    "unconstrained": Box((0.4, -0.7, 0.5), (1.4, 0.7, 1.5)),
    "constrained": Box((0.4, -0.7, 0.14), (1.35, 0.7, 1.245)),
}
START = Box((0.45, -0.55, 0.6), (1.0, 0.45, 1.2))  # of grippers at random starts
WORKSPACE = Box((0.35, -0.75, 0.1), (1.4, 0.75, 1.3))
BANK = 64
ROOM = 0.04  # m, between a rope's or a hand's middle and everything at random starts
TARGET_ROPE = OtherRope(bending_stiffness=0.032, twisting_stiffness=0.032, bending_damping=3.2e-3)
"""Chapter IV's other rope, whose joints have springs and ten times the damping; it is a stiff cable."""


def default_scene() -> Scene:
    """25 links of 3.2 cm between two grippers, and the bay: what stands straight in it is one obstacle.

    The rope is chapter IV's source rope. Its joints' Coulomb friction, which would hold it in any shape, is
    left out; a little bending stiffness stands in its place.
    """
    straight = tuple(_box(size, centre) for size, centre in BOXES)
    engine = Obstacle("engine", (*straight, Shape(ShapeKind.CYLINDER, TANK[0], TANK[1])))
    turned = [Obstacle("hood", (_box(HOOD[0]),))]
    turned += [Obstacle(f"bumper{i}", (_box(BUMPER),)) for i in range(len(BUMPERS))]
    return held_rope_scene("engine_bay", (engine, *turned), bending_damping=3.2e-4, friction=1.0)


class BayStart(Jittable):
    """Draws a start with everything of the bay where it stands."""

    alone: Start  # the rope's, which keeps clear of it
    position: Float[Array, "B 3"]  # m
    quaternion: Float[Array, "B 4"]

    def __call__(self, key: Array) -> SimState:
        """A start."""
        start = self.alone(key)
        return replace(start, obstacle_position=self.position, obstacle_quaternion=self.quaternion)


@dataclass(frozen=True)
class EngineBay(RopeTask):
    """Two grippers in space; a point of the rope's middle is to come within 4.5 cm of a place under a tab.

    Gripper 0 holds point 0's end and gripper 1 the last point's. The grippers are free hands without arms.
    Nothing of the bay moves from scene to scene. At random starts a rope hangs anywhere above it, and the
    goal lies up to 3 cm off the released code's along each axis; at the fixed one the rope hangs in front of
    the engine as there, and the goals are those four.
    """

    name: str = "engine_bay"
    phase: Phase = "constrained"
    starts: Literal["random", "fixed"] = "random"
    grippers: int = 2
    goal_threshold: float = 0.045
    goal_point: int = MIDPOINT  # of goals that name none
    workspace: Box = WORKSPACE
    scene: Scene = field(default_factory=default_scene)  # of both phases: in phase one all of it is parked

    @classmethod
    def of(cls, phase: Phase, crowd: int) -> "EngineBay":
        """The task in a phase.

        Raises:
            ValueError: for another crowd than 1.
        """
        if crowd != 1:
            raise ValueError(f"crowd is {crowd}, but engine_bay has one engine, expected 1")
        return cls(phase=phase)

    @property
    def trajectory_states(self) -> int:
        """States of a trajectory."""
        return 10 if self.phase == "unconstrained" else 20

    @property
    def actions(self) -> GripperMoves:
        """Displacements of at most 0.1 m each, within the phase's reach, no farther apart than it allows."""
        return GripperMoves(MAX_ACTION, REACH[self.phase], self.grippers, MAX_GAP[self.phase])

    @cached_property
    def _bank(self):
        from doojax.tasks.banks import bank_of
        from doojax.tasks.starts import RopeBank

        bank = bank_of(self.scene, self.settled)
        chosen = slice(-1, None) if self.starts == "fixed" else slice(-1)
        return RopeBank(bank.qpos[chosen], bank.points[chosen], bank.radius)

    def settled(self):
        """Ropes of the task's scene, simulated until they rest; the last one is the fixed start's."""
        from doojax.tasks.starts import hung_bank

        rng = np.random.default_rng(0)
        gap, tilt = rng.uniform(0.15, 0.70, BANK), rng.uniform(-0.5, 0.5, BANK)
        return hung_bank(self.scene, np.append(gap, HELD_GAP), np.append(tilt, 0.0))

    def start(self):
        """The function that draws a start from a key."""
        from doojax.tasks.starts import RandomStart

        check_phase(self.phase)
        constrained = self.phase == "constrained"
        place = _held if self.starts == "fixed" else partial(_hung, self.scene if constrained else None)
        alone = RandomStart(self._bank, scene=self.scene, place_rope=place, placements=None)
        return BayStart(alone, *bay_poses()) if constrained else alone

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Goal:
        """A place under a tab for any point of the rope's middle.

        At random starts it is at least the threshold from everything.
        """
        tab_key, place_key = jax.random.split(key)
        place = jnp.array(GOALS)[jax.random.randint(tab_key, (), 0, len(GOALS))]
        if self.starts == "random":
            under = place
            place = first_valid(
                place_key,
                lambda key: under + AROUND.sample(key),
                lambda goal: signed_distance(obstacles, goal) > self.goal_threshold,
                fallback=jnp.array(CLEAR),
            )
        return point_goal(self, place, points=GOAL_POINTS)


def bay_poses() -> tuple[Float[Array, "B 3"], Float[Array, "B 4"]]:
    """Where the scene's obstacles stand: positions (m) and quaternions (w, x, y, z)."""
    place, roll, yaw = BAY
    own = quaternion_multiply(_turned(0.0, 0.0, yaw), _turned(roll, 0.0, 0.0))
    parts = [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), (HOOD[1], HOOD[2])]
    parts += [((x, y, -0.04), (0.0, 0.0, turn)) for x, y, turn in BUMPERS]
    positions = [rotate(own, jnp.array(centre)) + jnp.array(place) for centre, _ in parts]
    quaternions = [quaternion_multiply(own, _turned(*turn)) for _, turn in parts]
    return jnp.stack(positions), jnp.stack(quaternions)


def _turned(x: float, y: float, z: float) -> Float[Array, "4"]:
    return quaternion_from_rotation_vector(jnp.array([x, y, z]))


def _box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Shape:
    return Shape(ShapeKind.BOX, (size[0] / 2, size[1] / 2, size[2] / 2), centre)


def _held(key: Array, points: Float[Array, "P 3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """The fixed start: hand 0 to the left of a robot that looks along x, hand 1 to the right."""
    middle = points[-2:].mean(0)  # a turn about z by a right angle leaves it on the axis, where it is
    return jnp.array(HELD) - middle, jnp.array(-jnp.pi / 2)


def _hung(
    scene: Scene | None, key: Array, points: Float[Array, "P 3"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Anywhere in reach where nothing is in the way, or among the scene's obstacles above and before them."""
    from doojax.tasks.starts import placed_within

    if scene is None:
        return placed_within(REACH["unconstrained"], 2 * RADIUS, key, points)
    bay = obstacles_at(scene, *bay_poses())

    def draw(key: Array) -> Float[Array, "4"]:
        move, yaw = placed_within(START, 2 * RADIUS, key, points)
        return jnp.append(move, yaw)

    def clear(placed: Float[Array, "4"]) -> Array:
        there = rotate(quaternion_from_yaw(placed[3]), points) + placed[:3]
        return signed_distance(bay, there).min() > ROOM

    move, yaw = _held(key, points)
    chosen = first_valid(key, draw, clear, fallback=jnp.append(move, yaw))
    return chosen[:3], chosen[3]
