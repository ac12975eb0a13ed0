"""Hold a rope by both ends over a cluttered table, bring its midpoint to a point (thesis section 2.5.3)."""

from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.actions import first_valid
from doojax.geometry.sdf import signed_distance
from doojax.goals import Goal
from doojax.simulation.scenes import Obstacle, Scene, Shape
from doojax.tasks.base import Box, Phase, check_phase
from doojax.tasks.grippers import GripperMoves, RopeTask, point_goal
from doojax.tasks.held_rope import MAX_ACTION, MAX_GAP, MIDPOINT, RADIUS, held_rope_scene
from doojax.types import Obstacles, ShapeKind

TABLE_TOP = 0.625  # m
BOXES = (  # full sizes, m
    (0.10, 0.05, 0.20),
    (0.11, 0.06, 0.21),
    (0.09, 0.07, 0.26),
    (0.06, 0.04, 0.14),
    (0.05, 0.16, 0.30),
)
REACH = {  # of gripper targets
    "unconstrained": Box((0.4, -0.7, 0.5), (1.4, 0.7, 1.5)),
    "constrained": Box((0.5, -0.6, 0.6), (1.2, 0.6, 1.2)),
}
WORKSPACE = Box((0.35, -0.7, 0.55), (1.3, 0.7, 1.35))  # of a plan's states, as in the released code
BANK = 128


def default_scene(crowd: int = 1) -> Scene:
    """25 links of 3.2 cm between two grippers, a table, five boxes and two hooks on it, times the crowd."""
    table = Obstacle("table", (_box((0.8, 1.5, 0.12)),), friction=0.6)
    boxes = [Obstacle(f"box{i}", (_box(size),), friction=1.0) for i, size in enumerate(BOXES)]
    hooks = [  # a post and, on top of it, a shelf or a bar; offsets from the post's centre
        Obstacle(
            "hook0", (_box((0.04, 0.14, 0.18)), _box((0.2, 0.14, 0.02), (-0.08, 0.0, 0.1))), friction=1.0
        ),
        Obstacle(
            "hook1", (_box((0.04, 0.08, 0.28)), _box((0.18, 0.08, 0.02), (0.0, 0.0, 0.14))), friction=1.0
        ),
    ]
    crowded = [
        replace(one, name=one.name if copy == 0 else f"{one.name}_{copy}")
        for copy in range(crowd)
        for one in (*boxes, *hooks)
    ]
    return held_rope_scene("dual_gripper", (table, *crowded), bending_damping=2e-4, friction=0.5)


@dataclass(frozen=True)
class DualGripper(RopeTask):
    """Two grippers in space; the rope's midpoint (point 12) is to come within 5 cm of a point.

    Gripper 0 holds point 0's end and gripper 1 the last point's, in states, actions and goals alike.
    Dimensions are those of the thesis's released code. The grippers are free hands without arms.
    """

    name: str = "dual_gripper"
    phase: Phase = "constrained"
    grippers: int = 2
    goal_threshold: float = 0.05
    goal_point: int = MIDPOINT
    workspace: Box = WORKSPACE
    scene: Scene = field(default_factory=default_scene)  # of both phases: in phase one obstacles are parked
    # where a dual arm stands that carries the hands, if arms are asked for: before the table, facing it
    arms_base: ClassVar[tuple[float, float, float]] = (0.1, 0.0, 0.8)  # m, on a plinth
    arms_yaw: ClassVar[float] = -np.pi / 2

    @classmethod
    def of(cls, phase: Phase, crowd: int) -> "DualGripper":
        """The task in a phase with ``crowd`` times the usual number of obstacles."""
        return cls(phase=phase, scene=default_scene(crowd))

    @property
    def trajectory_states(self) -> int:
        """States of a trajectory in the thesis's data."""
        return 10 if self.phase == "unconstrained" else 20

    @property
    def actions(self) -> GripperMoves:
        """Displacements of at most 0.1 m each, within the phase's reach and no farther apart than it allows.

        Drawn as in the released code; where nothing else is valid the grippers close in on each other.
        """
        return GripperMoves(MAX_ACTION, REACH[self.phase], self.grippers, MAX_GAP[self.phase])

    @cached_property
    def _bank(self):
        from doojax.tasks.banks import bank_of

        return bank_of(self.scene, self.settled)

    def settled(self):
        """Ropes of the task's scene, simulated until they rest."""
        from doojax.tasks.starts import hung_bank

        rng = np.random.default_rng(0)
        low, high = (0.15, MAX_GAP["unconstrained"])
        gap, tilt = rng.uniform(low, high, BANK), rng.uniform(-0.5, 0.5, BANK)
        return hung_bank(self.scene, gap, tilt)

    def start(self):
        """The function that draws a start from a key."""
        from doojax.tasks.starts import RandomStart

        check_phase(self.phase)
        return RandomStart(
            self._bank,
            scene=self.scene,
            place_rope=partial(_place_rope, REACH[self.phase]),
            placements=_placements(self.scene) if self.phase == "constrained" else None,
        )

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Goal:
        """A point for the midpoint, above the table, at least the threshold from every obstacle."""
        region = Box((0.6, -0.4, 0.6), (1.1, 0.4, 0.85))

        def clear(goal):
            return signed_distance(obstacles, goal) > self.goal_threshold

        place = first_valid(key, region.sample, clear, fallback=jnp.array([0.85, 0.0, 0.85]))
        return point_goal(self, place)


def _box(size: tuple[float, float, float], offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Shape:
    return Shape(ShapeKind.BOX, (size[0] / 2, size[1] / 2, size[2] / 2), offset)


def _place_rope(reach: Box, key: Array, points: Float[Array, "P 3"]) -> tuple[Array, Array]:
    """Turn a rope any way and move it so that both grippers are in reach and the rope is above the table."""
    from doojax.tasks.starts import placed_within

    return placed_within(reach, TABLE_TOP + 2 * RADIUS, key, points)


def _placements(scene: Scene):
    """What is called table where it stands, all else anywhere on it at any yaw."""
    from doojax.tasks.starts import Place, placements_of

    table = Place((0.8, 0.0, TABLE_TOP - 0.06))
    above = [
        Place((0.8, 0.0, TABLE_TOP + one.height), (0.2, 0.45), (-np.pi, np.pi)) for one in scene.obstacles
    ]
    return placements_of(
        scene, [table if one.name == "table" else at for one, at in zip(scene.obstacles, above, strict=True)]
    )
