"""A rope without physics, each point towed by the next: for tests of learners and planners."""

from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.actions import first_valid
from doojax.geometry.sdf import signed_distance
from doojax.goals import Goal
from doojax.modules import Jittable
from doojax.simulation.layout import Observation, clearance, stretch
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, Shape, obstacles_at, parked_poses
from doojax.simulation.state import SimState, at_rest
from doojax.tasks.base import Box, Phase, check_phase
from doojax.tasks.grippers import GripperMoves, RopeTask, point_goal
from doojax.types import Obstacles, RopeState, ShapeKind, Trajectory

LINKS, PITCH, RADIUS, HEIGHT = 5, 0.05, 0.01, 0.05
MAX_ACTION = 0.1
REACH = Box((-0.5, -0.5, HEIGHT), (0.5, 0.5, HEIGHT))
HANDS = Box((-0.5, -0.5, 0.0), (0.5, 0.5, 1.0))
WALL = (0.15, -0.1, HEIGHT)  # centre of the one obstacle, m
MORE = (-0.15, 0.2, HEIGHT)  # of the second; further ones stand where it does


def default_scene(crowd: int = 1) -> Scene:
    """Five points behind one gripper, and a wall in the middle of the floor, or more of them."""
    wall = Shape(ShapeKind.BOX, (0.02, 0.3, 0.1))
    return Scene(
        name="toy",
        rope_model=RopeModel("point_masses", LINKS),
        rope=RopeParameters(length=LINKS * PITCH, radius=RADIUS, mass=0.1, bending_stiffness=0.0),
        grippers=(Gripper(link=LINKS - 1, end=0, radius=RADIUS, max_force=1.0, max_speed=0.1),),
        obstacles=tuple(Obstacle(f"wall{i}" if i else "wall", (wall,)) for i in range(crowd)),
    )


def straight(gripper: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "N 3"]:
    """A straight rope from its tail to the gripper, which lies in the direction ``angle`` (rad)."""
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0.0])
    return gripper - PITCH * jnp.arange(LINKS - 1, -1, -1.0)[:, None] * direction


class ToySimulator(Jittable):
    """Analytic dynamics: the gripper stops where it would touch, and the rope follows, through walls too.

    So the model "the gripper gets where it is sent" holds in free space and fails at the wall.
    """

    scene: Scene = eqx.field(static=True)
    phase: Phase = eqx.field(static=True)

    def reset(self, key: Array) -> SimState:
        """A straight rope anywhere in reach, clear of the wall, pointing anywhere."""
        count = len(self.scene.obstacles)
        position, quaternion = parked_poses(count)
        if self.phase == "constrained":
            position = jnp.array([WALL] + [MORE] * (count - 1))
            quaternion = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count, 1))
        obstacles = obstacles_at(self.scene, position, quaternion)

        def draw(key):
            place_key, angle_key = jax.random.split(key)
            angle = jax.random.uniform(angle_key, maxval=2 * jnp.pi)
            return straight(REACH.sample(place_key), angle)

        def valid(points):
            return signed_distance(obstacles, points).min() > 2 * RADIUS

        away = straight(jnp.array([-0.3, 0.0, HEIGHT]), jnp.array(0.0))
        points = first_valid(key, draw, valid, fallback=away)
        gripper = points[-1]
        return at_rest(self.scene, jnp.concatenate([points, gripper[None]]).reshape(-1), position, quaternion)

    def step(self, state: SimState, action: Float[Array, "1 3"]) -> SimState:
        """Move the gripper by ``action`` (m) or until it touches the wall; then pull the points along."""
        rope, obstacles = self.observe(state), self.obstacles(state)
        fractions = jnp.linspace(0.0, 1.0, 21)
        path = rope.grippers[0] + fractions[:, None] * action[0] * jnp.array([1.0, 1.0, 0.0])
        free = signed_distance(obstacles, path) > RADIUS
        reached = jnp.where(free.all(), 20, jnp.maximum(jnp.argmin(free) - 1, 0))
        gripper = path[reached]

        def pull(leader, point):
            gap = point - leader
            distance = jnp.maximum(jnp.linalg.norm(gap), 1e-9)
            follower = leader + gap * jnp.minimum(1.0, PITCH / distance)
            return follower, follower

        _, behind = jax.lax.scan(pull, gripper, rope.points[:-1], reverse=True)
        points = jnp.concatenate([behind, gripper[None]])
        qpos = jnp.concatenate([points, gripper[None]]).reshape(-1)
        return eqx.tree_at(lambda s: s.qpos, state, qpos)

    def observe(self, state: SimState) -> RopeState:
        """Points and gripper, world frame, metres."""
        positions = state.qpos.reshape(-1, 3)
        return RopeState(points=positions[:LINKS], grippers=positions[LINKS:])

    @eqx.filter_jit
    def observations(self, states: SimState) -> Observation:
        """A batch of what `observe` gives."""
        return jax.vmap(self._observation)(states)

    def obstacles(self, state: SimState) -> Obstacles:
        """The wall where it is."""
        return obstacles_at(self.scene, state.obstacle_position, state.obstacle_quaternion)

    @eqx.filter_jit
    def rollout(self, states: SimState, actions: Float[Array, "B T 1 3"]) -> tuple[SimState, Trajectory]:
        """T steps of B elements. Returns the last states and all that was seen."""
        return jax.vmap(self._rollout_one)(states, actions)

    def _rollout_one(self, state: SimState, actions: Float[Array, "T 1 3"]) -> tuple[SimState, Trajectory]:
        def period(state, action):
            after = self.step(state, action)
            return after, after

        last, history = jax.lax.scan(period, state, actions)
        history = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state, history)
        seen, obstacles = self.observations(history), self.obstacles(state)
        return last, Trajectory(
            states=seen.state,
            actions=actions,
            faults=history.faults[1:],
            clearance=jax.vmap(lambda o: clearance(self.scene, obstacles, o))(seen),
            stretch=jax.vmap(lambda o: stretch(self.scene, state.holding, o))(seen),
        )

    def _observation(self, state: SimState) -> Observation:
        rope = self.observe(state)
        half_links = jnp.zeros_like(rope.points)
        return Observation(rope, rope.grippers, rope.points[-1:], half_links, jnp.array(RADIUS))


@dataclass(frozen=True)
class Toy(RopeTask):
    """One gripper in a plane; the tail (point 0) is to come within 5 cm of a point."""

    name: str = "toy"
    phase: Phase = "constrained"
    grippers: int = 1
    goal_threshold: float = 0.05
    goal_point: int = 0
    workspace: Box = REACH
    scene: Scene = field(default_factory=default_scene)

    @classmethod
    def of(cls, phase: Phase, crowd: int) -> "Toy":
        """The task in a phase with ``crowd`` times the usual number of obstacles."""
        return cls(phase=phase, scene=default_scene(crowd))

    @property
    def trajectory_states(self) -> int:
        """States of a trajectory."""
        return 10 if self.phase == "unconstrained" else 20

    @property
    def actions(self) -> GripperMoves:
        """Displacements of at most 0.1 m in the plane, to targets in reach."""
        return GripperMoves(MAX_ACTION, HANDS)

    def simulator(self, engine: str = "auto") -> ToySimulator:
        """The analytic dynamics, whatever the engine."""
        check_phase(self.phase)
        return ToySimulator(scene=self.scene, phase=self.phase)

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Goal:
        """A point for the tail, in reach, at least the threshold from the wall."""

        def clear(goal):
            return signed_distance(obstacles, goal) > self.goal_threshold

        place = first_valid(key, REACH.sample, clear, fallback=jnp.array([-0.3, 0.0, HEIGHT]))
        return point_goal(self, place)
