"""Pushed bodies as what is augmented: the hand and what moves with it move, what rests stays."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.augmentation.examples import LEAST_MOVE, Bounds, Movable, Setting
from doojax.geometry.motion import RigidMotion
from doojax.simulation.scenes import Scene
from doojax.simulation.state import SimState
from doojax.tasks.base import Task
from doojax.tasks.starts import moved_state
from doojax.types import Obstacles, PushingState, ShapeKind

EVERY = 3  # of a trajectory's states, the descent looks at one in so many
UPRIGHT = 10.0  # m, half the height of what stays: the way out of it is sideways


class PushingSetting(Setting):
    """What augmentations of pushed cylinders need to know of a task."""

    radii: Float[Array, "K"]  # m, of the N bodies, then of the hand

    @classmethod
    def of(cls, task: Task, bounds: Bounds = Bounds()) -> "PushingSetting":  # noqa: B008
        """A task's cylinders in its workspace.

        Raises:
            ValueError: bounds that move nothing in the plane.
        """
        scene, box = task.scene, task.workspace
        radii = [one.radius for one in (*scene.cylinders, *scene.grippers)]
        return cls(
            box_low=jnp.array(box.low, jnp.float32),
            box_high=jnp.array(box.high, jnp.float32),
            bounds=bounds.planar.array,
            radii=jnp.array(radii, jnp.float32),
        )

    def moving(self, states: PushingState) -> Bool[Array, "N"]:
        """Which bodies move at all, by more than a tenth of a millimetre."""
        way = states.positions - states.positions[:1]
        return ((way**2).sum(-1) > LEAST_MOVE**2).any(0)

    def movable(self, states: PushingState, obstacles: Any) -> Movable:
        """The hand and the bodies that move, in every state; those that rest are cylinders that stay."""
        mask, hand = self.moving(states), states.hand[:, None]
        # in place of a body that rests another look at the hand: shapes do not depend on who moves
        points = jnp.where(mask[:, None], states.positions, hand)
        radii = jnp.where(mask, self.radii[:-1], self.radii[-1])
        count = len(mask)
        stays = Obstacles(
            kind=jnp.full(count, int(ShapeKind.CYLINDER), jnp.int32),
            centre=states.positions[0],
            quaternion=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0], points.dtype), (count, 1)),
            half_size=jnp.stack(
                [self.radii[:-1], self.radii[:-1], jnp.full(count, UPRIGHT, points.dtype)], -1
            ),
            active=~mask,
        )
        every = jnp.concatenate([points, hand], axis=1)
        way = jnp.sqrt(((hand - hand[:1]) ** 2).sum(-1).max())
        numbers = np.arange(every.shape[0] * every.shape[1]).reshape(every.shape[:2])
        return Movable(
            points=every.reshape(-1, 3),
            radii=jnp.tile(jnp.append(radii, self.radii[-1]), len(every)),
            stays=stays,
            way=way,
            some=numbers[::EVERY].reshape(-1) if len(every) > EVERY else None,
        )

    def moved(self, states: PushingState, motion: RigidMotion) -> PushingState:
        """What moves, in all its states."""
        mask, there = self.moving(states)[:, None], states.moved(motion)
        return PushingState(
            positions=jnp.where(mask, there.positions, states.positions),
            velocities=jnp.where(mask, there.velocities, states.velocities),
            hand=there.hand,
        )

    def moved_start(
        self, scene: Scene, start: SimState, states: PushingState, motion: RigidMotion
    ) -> SimState:
        """With what moves elsewhere; what rests is as it was."""
        there = moved_state(scene, start, motion.about_origin, motion.quaternion)
        places, rests = scene.layout.places["cylinders"], ~self.moving(states)[:, None]

        def keep(new: Array, old: Array, addresses: np.ndarray) -> Array:
            return new.at[addresses].set(jnp.where(rests, old[addresses], new[addresses]))

        return replace(
            there,
            qpos=keep(there.qpos, start.qpos, places.qpos),
            qvel=keep(there.qvel, start.qvel, places.dofs),
        )

    def clearance(self, states: PushingState, obstacles: Any) -> None:
        """There are no obstacles."""
