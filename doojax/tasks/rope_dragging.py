"""Drag a rope over the floor among boxes and corners until its tail is at a point (thesis section 2.5.2)."""

from dataclasses import dataclass, field
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.actions import first_valid
from doojax.geometry.sdf import signed_distance
from doojax.goals import Goal
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, Shape, SolverSettings
from doojax.tasks.base import Box, Phase, check_phase
from doojax.tasks.grippers import GripperMoves, RopeTask, point_goal
from doojax.types import Obstacles, ShapeKind

LINKS, RADIUS = 10, 0.02
CUBES, CORNERS, WALLS = 6, 3, 4
CUBE, CORNER_HEIGHT, WALL_HEIGHT = 0.125, 0.05, 0.15  # half sizes, m
ARENA = 1.0  # m from the centre to a wall's middle
EXTENT = Box((-1.2, -1.2, 0.0), (1.2, 1.2, 1.0))  # of gripper targets
WORKSPACE = Box((-0.95, -0.95, RADIUS), (0.95, 0.95, RADIUS))  # within the walls
MAX_ACTION = 0.15  # m
BANK = 64


def default_scene(crowd: int = 1) -> Scene:
    """10 planar links of 5 cm on the floor, 6 cubes and 3 corners for each of the crowd, 4 walls."""
    cube = Shape(ShapeKind.BOX, (CUBE, CUBE, CUBE))
    corner = (
        Shape(ShapeKind.BOX, (0.25, 0.04, CORNER_HEIGHT)),
        Shape(ShapeKind.BOX, (0.04, 0.1, CORNER_HEIGHT), offset=(0.21, 0.1, 0.0)),
    )
    wall = Shape(ShapeKind.BOX, (0.05, 1.05, WALL_HEIGHT), wall=True)
    return Scene(
        name="rope_dragging",
        rope_model=RopeModel("planar_chain", LINKS),
        rope=RopeParameters(
            length=0.5, radius=RADIUS, mass=0.5, bending_stiffness=1e-4, bending_damping=1e-4, friction=0.1
        ),
        grippers=(Gripper(link=LINKS - 1, end=1, radius=0.02, max_force=10.0, max_speed=0.18),),
        obstacles=(
            *(Obstacle(f"cube{i}", (cube,)) for i in range(CUBES * crowd)),
            *(Obstacle(f"corner{i}", corner) for i in range(CORNERS * crowd)),
            *(Obstacle(f"wall{i}", (wall,)) for i in range(WALLS)),
        ),
        timestep=0.005,
        substeps=200,
        # Random drags meet at most 5 contacts at once. In a plane a pyramid's friction is Coulomb's.
        solver=SolverSettings(contact_time=0.01, cone="pyramidal", max_contact_points=10),
    )


@dataclass(frozen=True)
class RopeDragging(RopeTask):
    """One gripper, planar; the tail (point 0) is to come within 5 cm of a point.

    The arena, rope, obstacle sizes and action radius are those of the thesis's released code (0.15 m where
    the thesis's text says 0.1 m). Obstacles are drawn uniformly rather than nudged from a grid, so that
    scenes are independent, and stand still.
    """

    name: str = "rope_dragging"
    phase: Phase = "constrained"
    grippers: int = 1
    goal_threshold: float = 0.05
    goal_point: int = 0
    workspace: Box = WORKSPACE
    scene: Scene = field(default_factory=default_scene)  # of both phases: in phase one obstacles are parked

    @classmethod
    def of(cls, phase: Phase, crowd: int) -> "RopeDragging":
        """The task in a phase with ``crowd`` times the usual number of obstacles."""
        return cls(phase=phase, scene=default_scene(crowd))

    @property
    def trajectory_states(self) -> int:
        """States of a trajectory in the thesis's data."""
        return 10 if self.phase == "unconstrained" else 50

    @property
    def actions(self) -> GripperMoves:
        """Displacements in the plane, at most 0.15 m long, to within 1.2 m of the arena's centre lines."""
        return GripperMoves(MAX_ACTION, EXTENT)

    @cached_property
    def _bank(self):
        from doojax.tasks.banks import bank_of

        return bank_of(self.scene, self.settled)

    def settled(self):
        """Ropes of the task's scene, simulated until they rest."""
        from doojax.tasks.starts import settle_bank, straight_qpos

        rng = np.random.default_rng(0)
        angle = rng.uniform(-np.pi, np.pi, (BANK, 5)) * rng.uniform(0, 1, (BANK, 1))
        actions = MAX_ACTION * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
        starts = np.tile(straight_qpos(self.scene, RADIUS), (BANK, 1))
        return settle_bank(self.scene, starts, actions[:, :, None])

    def start(self):
        """The function that draws a start from a key."""
        from doojax.tasks.starts import RandomStart

        check_phase(self.phase)
        constrained = self.phase == "constrained"
        return RandomStart(
            self._bank,
            scene=self.scene,
            place_rope=partial(_place_rope, 0.8 if constrained else 1.0),
            placements=_placements(self.scene) if constrained else None,
        )

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Goal:
        """A point for the tail, in +-0.7 m, at least twice the threshold from every obstacle."""
        region = Box((-0.7, -0.7, RADIUS), (0.7, 0.7, RADIUS))

        def clear(goal):
            return signed_distance(obstacles, goal) > 2 * self.goal_threshold

        place = first_valid(key, region.sample, clear, fallback=jnp.array([0.0, 0.0, RADIUS]))
        return point_goal(self, place)


def _place_rope(extent: float, key: Array, points: Float[Array, "P 3"]) -> tuple[Array, Array]:
    """Turn a rope any way and put its middle anywhere that keeps it within ``extent`` (m) of the centre."""
    yaw_key, position_key = jax.random.split(key)
    yaw = jax.random.uniform(yaw_key, minval=-jnp.pi, maxval=jnp.pi)
    middle = points.mean(0)
    reach = jnp.linalg.norm(points - middle, axis=-1).max()
    room = jnp.maximum(extent - reach, 0.0)
    position = jax.random.uniform(position_key, (2,), minval=-room, maxval=room)
    turned = jnp.array(
        [
            jnp.cos(yaw) * middle[0] - jnp.sin(yaw) * middle[1],
            jnp.sin(yaw) * middle[0] + jnp.cos(yaw) * middle[1],
        ]
    )
    return jnp.append(position - turned, 0.0), yaw


def _placements(scene: Scene):
    """Walls where they stand, all else anywhere on the floor at any yaw."""
    from doojax.tasks.starts import Place, placements_of

    angles, places = iter(np.pi / 2 * np.arange(WALLS)), []
    for obstacle in scene.obstacles:
        if not any(shape.wall for shape in obstacle.shapes):
            places.append(Place((0.0, 0.0, obstacle.height), (0.8, 0.8), (-np.pi, np.pi)))
        elif (angle := next(angles, None)) is not None:
            at = (ARENA * np.cos(angle), ARENA * np.sin(angle), WALL_HEIGHT)
            places.append(Place(at, yaw=(angle + np.pi, angle + np.pi)))
        else:
            raise ValueError(f"obstacle {obstacle.name!r} is a wall too many: expected at most {WALLS}")
    return placements_of(scene, places)
