"""Hands that arms carry: whether the arms can be where a prediction has the hands."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.frames import quaternion_multiply
from doojax.modules import Jittable
from doojax.robots import Robot, are_free, tools_towards
from doojax.types import Judgement, Obstacles, Transition

ITERATIONS = 40  # of inverse kinematics, from each start
TOLERANCE = 5e-3  # m, that a tool may be off


class ArmsFeasible(Jittable):
    """Accepts transitions whose hands a robot can reach with its arms free; others are impossible.

    Hand i is the robot's tool i. A state does not say where joints are, so that each is judged by itself: by
    whether inverse kinematics, from any of some postures, finds joints within the limits that bring all tools
    there, free of obstacles, of the robot itself and of the floor. Some that could be are missed.
    """

    robot: Robot
    starts: Float[Array, "S J"]  # postures to look from
    base: tuple[float, float, float] = eqx.field(static=True)  # of the robot above the floor, m, world frame
    yaw: float = eqx.field(static=True, default=0.0)  # of the robot, rad
    moving: tuple[int, ...] = eqx.field(static=True, default=())  # joints that may move
    margin: float = eqx.field(static=True, default=0.0)  # m, to keep

    def __call__(self, obstacles: Obstacles, transition: Transition) -> Judgement:
        """The score is minus the metres that a tool is off from where its hand is to be."""
        hands = transition.next_state.grippers
        joints, off = self.postures(hands)
        free = (off <= TOLERANCE) & self.free(obstacles, joints)
        return Judgement(-off.min(), free.any(), free.any())

    def postures(self, hands: Float[Array, "G 3"]) -> tuple[Float[Array, "S J"], Float[Array, "S"]]:
        """Joints that each start leads to, and how far a tool is off then, m; hands in the world."""
        places = self.seen_from_base(hands)
        return jax.vmap(lambda start: tools_towards(self.robot, start, places, self.moving, ITERATIONS))(
            self.starts
        )

    def seen_from_base(self, places: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """Places of the world, m, in the robot's base's frame."""
        return self._turned(places - jnp.array(self.base), -self.yaw)

    def free(self, obstacles: Obstacles, joints: Float[Array, "S J"]) -> Bool[Array, "S"]:
        """Whether arms are free of obstacles (world frame), of themselves and of the floor at 0."""
        half = jnp.array([np.cos(self.yaw / 2), 0.0, 0.0, -np.sin(self.yaw / 2)])
        centre = self.seen_from_base(obstacles.centre)
        turn = quaternion_multiply(half, obstacles.quaternion)
        seen = eqx.tree_at(lambda o: (o.centre, o.quaternion), obstacles, (centre, turn))
        return are_free(self.robot, joints, seen, self.margin, -self.base[2])

    @staticmethod
    def _turned(vectors: Float[Array, "*n 3"], angle: float) -> Float[Array, "*n 3"]:
        x, y, z = jnp.moveaxis(vectors, -1, 0)
        cosine, sine = np.cos(angle), np.sin(angle)
        return jnp.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)
