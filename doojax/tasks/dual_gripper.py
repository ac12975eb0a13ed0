"""Hold a rope by both ends over a cluttered table, bring its midpoint to a point (thesis section 2.5.3)."""

from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.frames import exact_product, quaternion_from_yaw
from doojax.geometry.sdf import signed_distance
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, Shape, SolverSettings
from doojax.tasks.base import Box, Phase, check_phase, first_valid, repeated_or_drawn, short_enough
from doojax.types import Obstacles, RopeState, ShapeKind

LINKS, LENGTH, RADIUS = 25, 0.8, 0.01
MIDPOINT = 12
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
MAX_GAP = {
    "unconstrained": 0.70,
    "constrained": 0.78,
}  # m between the grippers
MAX_ACTION = 0.10  # m, each gripper
BANK = 128
SETTLE_PERIODS = 4


def default_scene(crowd: int = 1) -> Scene:
    """25 links of 3.2 cm between two grippers, a table, five boxes and two hooks on it, times the crowd."""
    hold = partial(Gripper, radius=0.01, max_force=5.0, max_speed=0.15)
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
    return Scene(
        name="dual_gripper",
        rope_model=RopeModel("capsule_chain", LINKS),
        rope=RopeParameters(
            length=LENGTH,
            radius=RADIUS,
            mass=0.2,
            bending_stiffness=5e-5,
            twisting_stiffness=5e-5,
            bending_damping=2e-4,
            friction=0.5,
        ),
        grippers=(hold(link=0, end=-1), hold(link=LINKS - 1, end=1)),
        obstacles=(table, *crowded),
        timestep=0.006,
        substeps=150,
        viscosity=0.15,  # else the rope still swings at the end of a period, 8 mm RMS in the next
        solver=SolverSettings(contact_time=0.012),
    )


@dataclass(frozen=True)
class DualGripper:
    """Two grippers in space; the rope's midpoint (point 12) is to come within 5 cm of a point.

    Gripper 0 holds point 0's end and gripper 1 the last point's, in states, actions and goals alike.
    Dimensions are those of the thesis's released code. The grippers are free hands without arms.
    """

    name: str = "dual_gripper"
    grippers: int = 2
    goal_threshold: float = 0.05
    goal_point: int = MIDPOINT
    workspace: Box = WORKSPACE
    scene: Scene = field(default_factory=default_scene)  # of both phases: in phase one obstacles are parked

    @classmethod
    def crowded(cls, crowd: int) -> "DualGripper":
        """The task with ``crowd`` times the usual number of obstacles."""
        return cls(scene=default_scene(crowd))

    @property
    def trajectory_states(self) -> dict[str, int]:
        """States of a trajectory in the thesis's data, by phase."""
        return {"unconstrained": 10, "constrained": 20}

    @cached_property
    def _bank(self):
        from doojax.tasks.starts import settle_bank, straight_qpos

        # from taut and straight, bring the ends together to a gap of 0.15 to 0.70 m, then let the rope settle
        rng = np.random.default_rng(0)
        low, high = (0.15, MAX_GAP["unconstrained"])
        gap, tilt = rng.uniform(low, high, BANK), rng.uniform(-0.5, 0.5, BANK)
        half = gap / 2
        end = np.stack([half * np.cos(tilt), np.zeros(BANK), half * np.sin(tilt)], -1)
        target = np.stack([-end, end], 1)
        start = np.array([[-LENGTH / 2, 0, 0], [LENGTH / 2, 0, 0]])
        speed = self.scene.grippers[0].max_speed * self.scene.control_period
        moves = int(np.ceil(np.abs(target - start).max() * 1.5 / speed))
        step = (target - start)[:, None] / moves
        actions = np.concatenate([np.repeat(step, moves, 1), np.zeros((BANK, SETTLE_PERIODS, 2, 3))], axis=1)
        return settle_bank(self.scene, np.tile(straight_qpos(self.scene, 1.0), (BANK, 1)), actions)

    def start(self, phase: Phase = "constrained"):
        """The function that draws a start from a key."""
        from doojax.tasks.starts import RandomStart

        check_phase(phase)
        crowd = (len(self.scene.obstacles) - 1) // (len(BOXES) + 2)
        return RandomStart(
            self._bank,
            scene=self.scene,
            place_rope=partial(_place_rope, REACH[phase]),
            placements=_placements(crowd) if phase == "constrained" else None,
        )

    def simulator(self, engine: str = "auto", phase: Phase = "constrained"):
        """The scene on an engine; see `Task.simulator`."""
        from doojax.simulation.engines import make_simulator

        return make_simulator(self.scene, self.start(phase), engine)

    def sample_action(
        self, key: Array, state: RopeState, previous: Float[Array, "2 3"], phase: Phase = "constrained"
    ) -> Float[Array, "2 3"]:
        """Displacements of at most 0.1 m each, the same as before with probability 0.8.

        Direction by uniform pitch and yaw, length uniform (more small moves than a uniform ball has), as in
        the released code. Redrawn if a target leaves the reach or the grippers part by more than the phase
        allows; failing that the grippers close in on each other.
        """
        return repeated_or_drawn(self, key, state, previous, phase)

    def draw_action(self, key: Array) -> Float[Array, "2 3"]:
        """Uniform in pitch, yaw and length, each gripper by itself."""
        pitch_key, yaw_key, length_key = jax.random.split(key, 3)
        pitch = jax.random.uniform(pitch_key, (2,), minval=-jnp.pi, maxval=jnp.pi)
        yaw = jax.random.uniform(yaw_key, (2,), minval=-jnp.pi, maxval=jnp.pi)
        length = jax.random.uniform(length_key, (2, 1), maxval=MAX_ACTION)
        direction = [jnp.cos(pitch) * jnp.cos(yaw), jnp.cos(pitch) * jnp.sin(yaw), jnp.sin(pitch)]
        return length * jnp.stack(direction, axis=-1)

    def retreat(self, state: RopeState, phase: Phase = "constrained") -> Float[Array, "2 3"]:
        """The grippers close in on each other, in reach."""
        inside = REACH[phase].clip(state.grippers)
        closing = 0.9 * (inside - inside.mean(0)) + inside.mean(0) - state.grippers
        return closing * jnp.minimum(
            1.0, MAX_ACTION / (jnp.linalg.norm(closing, axis=-1, keepdims=True) + 1e-9)
        )

    def valid_action(
        self, state: RopeState, action: Float[Array, "2 3"], phase: Phase = "constrained"
    ) -> Bool[Array, ""]:
        """Moves of at most 0.1 m to targets in reach, no further apart than the phase allows?"""
        target = state.grippers + action
        gap = jnp.linalg.norm(target[0] - target[1])
        inside = REACH[phase].contains(target).all()
        return inside & (gap < MAX_GAP[phase]) & short_enough(action, MAX_ACTION)

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Float[Array, "3"]:
        """A point for the midpoint, above the table, at least the threshold from every obstacle."""
        region = Box((0.6, -0.4, 0.6), (1.1, 0.4, 0.85))

        def clear(goal):
            return signed_distance(obstacles, goal) > self.goal_threshold

        return first_valid(key, region.sample, clear, fallback=jnp.array([0.85, 0.0, 0.85]))

    def goal_distance(self, state: RopeState, goal: Float[Array, "3"]) -> Float[Array, ""]:
        """Metres between the rope's midpoint and ``goal``."""
        return jnp.linalg.norm(state.points[MIDPOINT] - goal)


def _box(size: tuple[float, float, float], offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Shape:
    return Shape(ShapeKind.BOX, (size[0] / 2, size[1] / 2, size[2] / 2), offset)


def _place_rope(reach: Box, key: Array, points: Float[Array, "P 3"]) -> tuple[Array, Array]:
    """Turn a rope any way and move it so that both grippers are in reach and the rope is above the table."""
    yaw_key, position_key = jax.random.split(key)
    yaw = jax.random.uniform(yaw_key, minval=-jnp.pi, maxval=jnp.pi)
    cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
    turned = exact_product(points, jnp.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]))
    grippers = turned[-2:]
    low = jnp.array(reach.low) - grippers.min(0)
    high = jnp.array(reach.high) - grippers.max(0)
    low = low.at[2].max(TABLE_TOP + 2 * RADIUS - turned[:, 2].min())
    return jax.random.uniform(position_key, (3,), minval=low, maxval=jnp.maximum(high, low)), yaw


def _placements(crowd: int):
    """The table where it stands, boxes and hooks anywhere on it at any yaw."""

    def table(key):
        return jnp.array([0.8, 0.0, TABLE_TOP - 0.06]), jnp.array([1.0, 0.0, 0.0, 0.0])

    def on_table(height, key):
        position_key, yaw_key = jax.random.split(key)
        low, high = jnp.array([0.6, -0.45]), jnp.array([1.0, 0.45])
        x, y = jax.random.uniform(position_key, (2,), minval=low, maxval=high)
        yaw = jax.random.uniform(yaw_key, minval=-jnp.pi, maxval=jnp.pi)
        return jnp.stack([x, y, jnp.array(TABLE_TOP + height / 2)]), quaternion_from_yaw(yaw)

    heights = [size[2] for size in BOXES] + [0.18, 0.28]
    return (table, *(partial(on_table, height) for height in heights * crowd))
