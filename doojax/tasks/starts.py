"""Starts: a settled rope, somewhere, among obstacles that leave it room.

A bank of settled rope shapes is simulated once per task; a start is one of them, turned and moved, with
obstacles drawn around it. Drawing it runs no physics, so it can be jitted and vmapped by thousands.
"""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.frames import quaternion_from_yaw, quaternion_yaw, rotate
from doojax.geometry.sdf import signed_distance
from doojax.modules import Jittable
from doojax.simulation.layout import moved as moved_parts
from doojax.simulation.parts import Turn
from doojax.simulation.scenes import Scene, obstacles_at, parked_poses
from doojax.simulation.state import Fault, SimState, at_rest

CLEARANCE = 0.01  # m between the rope or a gripper and any obstacle at the start
PLACEMENTS = 64  # tried for each obstacle

Placement = Callable[[Array], tuple[Float[Array, "3"], Float[Array, "4"]]]
"""Draws an obstacle's position (m) and quaternion (w, x, y, z) from a key."""


class RopeBank(eqx.Module):
    """K settled ropes of one scene."""

    qpos: Float[Array, "K nq"]
    points: Float[Array, "K P 3"]  # samples along rope and grippers, world frame, m
    radius: Float[Array, "P"]  # m, of rope or gripper around each sample


class RandomStart(Jittable):
    """Draws a SimState; see the module."""

    bank: RopeBank
    scene: Scene = eqx.field(static=True)
    place_rope: Callable = eqx.field(static=True)  # (key, points [P, 3]) -> translation [3], yaw []
    placements: tuple[Placement, ...] | None = eqx.field(static=True)  # None: all obstacles parked

    def __call__(self, key: Array) -> SimState:
        """A start; `Fault.SCENE_OVERFULL` where an obstacle found no room and stays parked."""
        shape_key, rope_key, obstacle_key = jax.random.split(key, 3)
        shape = jax.random.randint(shape_key, (), 0, self.bank.qpos.shape[0])
        translation, yaw = self.place_rope(rope_key, self.bank.points[shape])
        qpos = moved(self.scene, self.bank.qpos[shape], translation, yaw)
        points = rotate(quaternion_from_yaw(yaw), self.bank.points[shape]) + translation
        position, quaternion = parked_poses(len(self.scene.obstacles))
        overfull = jnp.array(False)
        if self.placements is not None:
            position, quaternion, overfull = self._place_obstacles(self.placements, obstacle_key, points)
        start = at_rest(self.scene, qpos, position, quaternion)
        return replace(start, faults=jnp.where(overfull, int(Fault.SCENE_OVERFULL), 0))

    def _place_obstacles(
        self, placements: tuple[Placement, ...], key: Array, points: Float[Array, "P 3"]
    ) -> tuple[Float[Array, "B 3"], Float[Array, "B 4"], Bool[Array, ""]]:
        positions, quaternions, placed = [], [], []
        parked_position, parked_quaternion = parked_poses(1)
        keys = jax.random.split(key, len(self.scene.obstacles))
        for obstacle, placement, own_key in zip(self.scene.obstacles, placements, keys, strict=True):
            alone = replace(self.scene, obstacles=(obstacle,))

            def clear(position, quaternion, alone=alone):
                body = obstacles_at(alone, position[None], quaternion[None])
                return (signed_distance(body, points) - self.bank.radius).min() > CLEARANCE

            position, quaternion = jax.vmap(placement)(jax.random.split(own_key, PLACEMENTS))
            accepted = jax.vmap(clear)(position, quaternion)
            first = jnp.argmax(accepted)
            positions.append(jnp.where(accepted.any(), position[first], parked_position[0]))
            quaternions.append(jnp.where(accepted.any(), quaternion[first], parked_quaternion[0]))
            placed.append(accepted.any())
        return jnp.stack(positions), jnp.stack(quaternions), ~jnp.stack(placed).all()


def moved(
    scene: Scene, qpos: Float[Array, "nq"], translation: Float[Array, "3"], yaw: Float[Array, ""]
) -> Float[Array, "nq"]:
    """Turn rope and grippers about the world's z axis by ``yaw`` (rad), then move by ``translation`` (m)."""
    still = jnp.zeros(scene.nv, qpos.dtype)
    return moved_parts(scene, qpos, still, Turn(quaternion_from_yaw(yaw), yaw, translation))[0]


def moved_state(
    scene: Scene, state: SimState, translation: Float[Array, "3"], quaternion: Float[Array, "4"]
) -> SimState:
    """All that moves turned about the world's origin, then moved by ``translation`` (m).

    Velocities and commands go with it, obstacles stay. In a planar scene only the turn about z and the
    translation in the plane count.
    """
    yaw = quaternion_yaw(quaternion)
    turn = Turn(quaternion_from_yaw(yaw) if scene.planar else quaternion, yaw, translation)
    qpos, qvel = moved_parts(scene, state.qpos, state.qvel, turn)
    commanded = scene.driver.moved_command(state.commanded, turn)
    return replace(state, qpos=qpos, qvel=qvel, commanded=commanded)


def settle_bank(
    scene: Scene, starts: Float[np.ndarray, "K nq"], actions: Float[np.ndarray, "K T G 3"]
) -> RopeBank:
    """Simulate K ropes through T control periods on MuJoCo C, without obstacles, and keep the last states.

    Raises RuntimeError if a rope comes out unstable.
    """
    from doojax.simulation.engines.mujoco import MujocoSimulator

    count = len(starts)
    states = resting(scene, starts)
    simulator = MujocoSimulator(scene, start=lambda key: states)
    last, trajectory = simulator.rollout(states, jnp.asarray(actions))
    if np.any(trajectory.faults):
        raise RuntimeError(f"the rope of scene {scene.name!r} is unstable on its own: change its parameters")
    seen = simulator.observations(last)
    steps = np.linspace(-1, 1, 3)[:, None, None]
    points = (seen.state.points[:, None] + steps * seen.half_links[:, None]).reshape(count, -1, 3)
    rope, hands = scene.rope_part.parameters, [gripper.radius for gripper in scene.grippers]
    radius = [rope.radius] * (3 * scene.links) + hands
    return RopeBank(
        qpos=last.qpos,
        points=jnp.concatenate([jnp.asarray(points), jnp.asarray(seen.hands)], axis=1),
        radius=jnp.array(radius),
    )


def resting(scene: Scene, qpos: Float[np.ndarray, "K nq"]) -> SimState:
    """K states with these positions, at rest, every gripper holding the rope, all obstacles parked."""
    parked = parked_poses(len(scene.obstacles))
    return jax.vmap(lambda own: at_rest(scene, own, *parked))(jnp.asarray(qpos, dtype=jnp.float32))


def straight_qpos(scene: Scene, height: float) -> Float[np.ndarray, "nq"]:
    """Generalised positions: rope straight along x at ``height`` (m), grippers at the ends they hold."""
    rope, places = scene.rope_part, scene.layout.places
    qpos = np.zeros(scene.nq)
    if not scene.planar:
        qpos[places[rope.name].qpos] = [rope.root_offset, 0.0, height, 1.0, 0.0, 0.0, 0.0]
    for gripper, addresses in zip(scene.grippers, scene.layout.driven, strict=True):
        x = 0.0 if gripper.link is None else rope.along(gripper.link, gripper.end)
        qpos[addresses] = [x, 0.0] if scene.planar else [x, 0.0, height]
    return qpos
