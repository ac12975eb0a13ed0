"""Ropes as what is augmented: rope and grippers move, obstacles stay."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.augmentation.examples import Bounds, Movable, Setting
from doojax.geometry.motion import RigidMotion
from doojax.geometry.sdf import signed_distance
from doojax.simulation.scenes import Scene
from doojax.simulation.state import SimState
from doojax.tasks.base import Box, Task
from doojax.tasks.starts import moved_state
from doojax.types import Obstacles, RopeState, ShapeKind

UPRIGHT = 10.0  # m, half the height of obstacles that a planar rope meets


class RopeSetting(Setting):
    """What augmentations of a task's ropes need to know of it."""

    rope_radius: Float[Array, ""]  # m
    gripper_radii: Float[Array, "G"]
    planar: bool = eqx.field(static=True)

    @classmethod
    def of(cls, task: Task, bounds: Bounds = Bounds(), box: Box | None = None) -> "RopeSetting":  # noqa: B008
        """A task's ropes in its workspace, or in another box.

        Raises:
            ValueError: bounds that move nothing in the task's plane.
        """
        scene, box = task.scene, task.workspace if box is None else box
        planar = scene.planar or box.low[2] == box.high[2]
        return cls(
            rope_radius=jnp.array(scene.rope_part.parameters.radius, jnp.float32),
            gripper_radii=jnp.array([gripper.radius for gripper in scene.grippers], jnp.float32),
            box_low=jnp.array(box.low, jnp.float32),
            box_high=jnp.array(box.high, jnp.float32),
            bounds=(bounds.planar if planar else bounds).array,
            planar=planar,
        )

    def movable(self, states: RopeState, obstacles: Obstacles) -> Movable:
        """Rope and grippers, also on the straight way from state to state."""
        points, radii = moving_points(self, states)
        ways = [jnp.abs(leaf - leaf[:1]).max() for leaf in (states.points, states.grippers)]
        return Movable(points, radii, self._around(obstacles), jnp.maximum(*ways))

    def moved(self, states: RopeState, motion: RigidMotion) -> RopeState:
        """All of it."""
        return states.moved(motion)

    def moved_start(self, scene: Scene, start: SimState, states: RopeState, motion: RigidMotion) -> SimState:
        """All of it."""
        return moved_state(scene, start, motion.about_origin, motion.quaternion)

    def clearance(self, states: RopeState, obstacles: Obstacles) -> Float[Array, "T1"]:
        """Of rope and grippers."""
        points, radii = moving_points(self, states, between=0)
        distance = signed_distance(self._around(obstacles), points) - radii
        return distance.reshape(len(states.points), -1).min(-1)

    def _around(self, obstacles: Obstacles) -> Obstacles:
        return upright(obstacles) if self.planar else obstacles


def moving_points(
    setting: RopeSetting, states: RopeState, between: int = 2
) -> tuple[Float[Array, "Q 3"], Float[Array, "Q"]]:
    """Points on the axis of the rope and the grippers' centres at T + 1 states and between them, and radii.

    On the rope: link centres, the middles between them, and both ends half a link beyond. ``between`` looks
    on the straight way from each state to the next.
    """
    points = states.points
    middle = (points[:, 1:] + points[:, :-1]) / 2
    ends = jnp.stack([1.5 * points[:, 0] - 0.5 * points[:, 1], 1.5 * points[:, -1] - 0.5 * points[:, -2]], 1)
    at = jnp.concatenate([points, middle, ends, states.grippers], axis=1)  # [T+1, P, 3]
    radii = jnp.concatenate(
        [jnp.full(at.shape[1] - states.grippers.shape[1], setting.rope_radius), setting.gripper_radii]
    ).astype(at.dtype)
    steps = jnp.arange(1, between + 1, dtype=at.dtype)[:, None, None, None] / (between + 1)
    ways = (at[None, :-1] + steps * (at[None, 1:] - at[None, :-1])).reshape(-1, *at.shape[1:])
    every = jnp.concatenate([at, ways])
    return every.reshape(-1, 3), jnp.tile(radii, len(every))


def upright(obstacles: Obstacles) -> Obstacles:
    """Obstacles without top or bottom, for ropes that stay in a plane: the way out of one is sideways.

    Boxes and cylinders have to stand; capsules stay as they are.
    """
    tall = obstacles.half_size.at[..., 2].set(UPRIGHT)
    capsule = (obstacles.kind == ShapeKind.CAPSULE)[..., None]
    return replace(obstacles, half_size=jnp.where(capsule, obstacles.half_size, tall))
