"""A task that is no rope: push a cylinder over a table, past a post, to a place; doojax knows none such."""

from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from doojax.actions import first_valid
from doojax.geometry.sdf import signed_distance
from doojax.goals import goal_of
from doojax.modules import Jittable
from doojax.simulation.engines import make_simulator
from doojax.simulation.scenes import Cylinder, Gripper, Obstacle, Scene, Shape, parked_poses
from doojax.simulation.state import at_rest
from doojax.tasks.base import Box
from doojax.tasks.grippers import GripperMoves
from doojax.types import PushingState, ShapeKind

RADIUS, LONGEST = 0.03, 0.05  # m
TABLE = Box((-0.4, -0.4, RADIUS), (0.4, 0.4, RADIUS))
POST = Shape(ShapeKind.CYLINDER, (0.04, 0.04, 0.1))


def pushed_scene() -> Scene:
    return Scene(
        name="pushing",
        rope_model=None,
        rope=None,
        grippers=(Gripper(link=None, end=0, radius=0.02, max_force=20.0, max_speed=0.3),),
        obstacles=(Obstacle("post", (POST,)),),
        timestep=0.004,
        substeps=50,
        cylinders=(Cylinder(RADIUS, 0.04, 0.1, 0.4),),
    )


class Start(Jittable):
    """The hand 6 cm from the cylinder, and in the constrained phase a post somewhere else."""

    scene: Scene = eqx.field(static=True)
    with_post: bool = eqx.field(static=True)

    def __call__(self, key: Array):
        place, side = jax.random.split(key)
        cylinder = 0.6 * TABLE.sample(place)
        angle = jax.random.uniform(side, maxval=2 * jnp.pi)
        way = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        hand = cylinder[:2] + 0.06 * way
        position, quaternion = parked_poses(1)
        if self.with_post:  # 20 cm from the cylinder, at right angles to the hand
            across = cylinder[:2] + 0.2 * jnp.array([-1.0, 1.0]) * way[::-1]
            position = jnp.append(across, 0.1)[None]
        qpos = jnp.zeros(self.scene.nq)
        qpos = qpos.at[self.scene.layout.driven[0]].set(hand)
        qpos = qpos.at[self.scene.layout.places["cylinders"].qpos[0, :2]].set(cylinder[:2])
        return at_rest(self.scene, qpos, position, quaternion)


@dataclass(frozen=True)
class Pushing:
    """Bring the cylinder within 4 cm of a place."""

    name: str = "pushing"
    phase: str = "constrained"
    scene: Scene = field(default_factory=pushed_scene)
    grippers: int = 1
    trajectory_states: int = 6
    actions: GripperMoves = GripperMoves(LONGEST, Box((-0.5, -0.5, 0.0), (0.5, 0.5, 1.0)))  # noqa: RUF009
    workspace: Box = TABLE
    goal_threshold: float = 0.04
    goal_point: int = 0  # the cylinder

    @classmethod
    def of(cls, phase: str, crowd: int) -> "Pushing":
        return cls(phase=phase)

    @property
    def blank(self) -> PushingState:
        return PushingState(jnp.zeros((1, 3)), jnp.zeros((1, 3)), jnp.zeros(3))

    def simulator(self, engine: str = "auto"):
        return make_simulator(self.scene, Start(self.scene, self.phase == "constrained"), engine)

    def sample_goal(self, key: Array, obstacles):
        place = first_valid(
            key,
            TABLE.sample,
            lambda one: signed_distance(obstacles, one) > 0.1,
            jnp.zeros(3).at[2].set(RADIUS),
        )
        return goal_of([place], [[0]], 2, self.goal_threshold)

    def reach(self):
        return np.full((2, 2), np.inf)


class Pushed(Jittable):
    """Dynamics to learn: where the cylinder goes, from where it is beside the hand, and the action."""

    network: eqx.nn.MLP

    def __init__(self, width: int, *, key: Array):
        self.network = eqx.nn.MLP(4, 2, width, 2, key=key)

    def __call__(self, obstacles, state: PushingState, action: Array):
        beside = (state.positions[0] - state.hand)[:2]
        change = 0.05 * self.network(jnp.concatenate([beside, action[0, :2]]) / 0.1)
        moved = state.positions + jnp.append(change, 0.0)[None]
        hand = (state.hand + action[0]).at[2].set(state.hand[2])
        return PushingState(moved, jnp.zeros_like(state.velocities), hand), jnp.zeros(())
