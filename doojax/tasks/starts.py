"""Starts: a settled rope, somewhere, among obstacles that leave it room.

A bank of settled rope shapes is simulated once per task; a start is one of them, turned and moved, with
obstacles drawn around it. Drawing it runs no physics, so it can be jitted and vmapped by thousands.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.box import Box
from doojax.geometry.frames import (
    exact_product,
    quaternion_from_yaw,
    quaternion_yaw,
    rotate,
)
from doojax.geometry.sdf import signed_distance
from doojax.modules import Jittable
from doojax.simulation.layout import moved as moved_parts
from doojax.simulation.parts import Turn
from doojax.simulation.scenes import Scene, Shape, parked_poses
from doojax.simulation.state import Fault, SimState, at_rest
from doojax.types import Obstacles, ShapeKind

CLEARANCE = 0.01  # m between the rope or a gripper and any obstacle at the start
PLACEMENTS = 64  # tried for each obstacle
SETTLE_PERIODS = 4  # in which a rope that hangs from two hands comes to rest


class Placements(eqx.Module):
    """Where each of B obstacles may stand: anywhere in a box, turned by any of a range of angles about z."""

    low: Float[Array, "B 3"]  # of positions, world frame, m
    high: Float[Array, "B 3"]
    yaw: Float[Array, "B 2"]  # least and greatest, rad

    def draw(self, key: Array) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        """A position (m) and quaternion (w, x, y, z) of one obstacle, whose row these ranges are."""
        position_key, yaw_key = jax.random.split(key)
        place = jax.random.uniform(position_key, (2,), minval=self.low[:2], maxval=self.high[:2])
        yaw = jax.random.uniform(yaw_key, minval=self.yaw[0], maxval=self.yaw[1])
        return jnp.append(place, self.low[2]), quaternion_from_yaw(yaw)


@dataclass(frozen=True)
class Place:
    """Where an obstacle stands: at a place, or anywhere near it."""

    position: tuple[float, float, float]  # of its origin, world frame, m
    spread: tuple[float, float] = (0.0, 0.0)  # m: drawn uniformly from so far to either side, along x and y
    yaw: tuple[float, float] = (0.0, 0.0)  # rad: drawn uniformly between these turns about z

    @property
    def fixed(self) -> bool:
        """Does it always stand alike?"""
        return self.spread == (0.0, 0.0) and self.yaw[0] == self.yaw[1]


def placements_of(scene: Scene, places: Sequence[Place]) -> Placements | None:
    """Where each obstacle of a scene may stand; None where there are none.

    Raises:
        ValueError: for another number of places than of obstacles.
    """
    if len(places) != len(scene.obstacles):
        names = ", ".join(obstacle.name for obstacle in scene.obstacles) or "none"
        raise ValueError(
            f"there are {len(places)} places for {len(scene.obstacles)} obstacles ({names}): expected as many"
        )
    if not places:
        return None
    middle = np.array([place.position for place in places])
    spread = np.array([(*place.spread, 0.0) for place in places])
    yaw = np.array([place.yaw for place in places])
    return Placements(*(jnp.asarray(one, jnp.float32) for one in (middle - spread, middle + spread, yaw)))


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
    placements: Placements | None  # None: all obstacles parked

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
        self, placements: Placements, key: Array, points: Float[Array, "P 3"]
    ) -> tuple[Float[Array, "B 3"], Float[Array, "B 4"], Bool[Array, ""]]:
        parked_position, parked_quaternion = (one[0] for one in parked_poses(1))

        def place(given: tuple[Array, Array, Obstacles]) -> tuple[Array, Array, Array]:
            position, quaternion, shapes = given

            def clear(position, quaternion):
                there = replace(
                    shapes,
                    centre=position + rotate(quaternion, shapes.centre),
                    quaternion=jnp.broadcast_to(quaternion, shapes.quaternion.shape),
                )
                return (signed_distance(there, points) - self.bank.radius).min() > CLEARANCE

            accepted = jax.vmap(clear)(position, quaternion)
            first, any_is = jnp.argmax(accepted), accepted.any()
            return (
                jnp.where(any_is, position[first], parked_position),
                jnp.where(any_is, quaternion[first], parked_quaternion),
                any_is,
            )

        def tried(own_key: Array, ranges: Placements) -> tuple[Array, Array]:
            return jax.vmap(ranges.draw)(jax.random.split(own_key, PLACEMENTS))

        drawn = jax.vmap(tried)(jax.random.split(key, len(self.scene.obstacles)), placements)
        # one after the other, because what is compiled is then one obstacle's
        positions, quaternions, placed = jax.lax.map(place, (*drawn, shapes_of(self.scene)))
        return positions, quaternions, ~placed.all()


def shapes_of(scene: Scene) -> Obstacles:
    """The shapes of each of the scene's B obstacles in its own frame, fields ``[B, S, ...]``.

    What has fewer shapes than the S of that which has most is filled up with inactive ones.
    """
    most = max(len(obstacle.shapes) for obstacle in scene.obstacles)
    blank = Shape(ShapeKind.BOX, (1.0, 1.0, 1.0))
    rows = [(*one.shapes, *[blank] * (most - len(one.shapes))) for one in scene.obstacles]
    lengths = np.array([len(one.shapes) for one in scene.obstacles])
    return Obstacles(
        kind=jnp.array([[int(shape.kind) for shape in row] for row in rows], jnp.int32),
        centre=jnp.array([[shape.offset for shape in row] for row in rows], jnp.float32),
        quaternion=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (len(rows), most, 1)),
        half_size=jnp.array([[shape.half_size for shape in row] for row in rows], jnp.float32),
        active=jnp.asarray(np.arange(most) < lengths[:, None]),
    )


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


def hung_bank(scene: Scene, gap: Float[np.ndarray, "K"], tilt: Float[np.ndarray, "K"]) -> RopeBank:
    """K ropes that hang from two hands which hold their ends, along x.

    From taut and straight the hands bring the ends together, then the rope settles.

    Args:
        scene: with two hands at a rope's ends.
        gap: between the hands, m.
        tilt: of the way from one hand to the other, rad.
    """
    length, half = scene.rope_part.parameters.length, gap / 2
    end = np.stack([half * np.cos(tilt), np.zeros(len(gap)), half * np.sin(tilt)], -1)
    target = np.stack([-end, end], 1)
    start = np.array([[-length / 2, 0, 0], [length / 2, 0, 0]])
    speed = scene.grippers[0].max_speed * scene.control_period
    moves = int(np.ceil(np.abs(target - start).max() * 1.5 / speed))
    step = (target - start)[:, None] / moves
    still = np.zeros((len(gap), SETTLE_PERIODS, 2, 3))
    actions = np.concatenate([np.repeat(step, moves, 1), still], axis=1)
    height = max(1.0, 0.75 * length)  # above the floor, if there is one
    return settle_bank(scene, np.tile(straight_qpos(scene, height), (len(gap), 1)), actions)


def placed_within(
    reach: Box, lowest: float, key: Array, points: Float[Array, "P 3"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """A move and a turn (rad) by which a hung rope's two hands, its last points, get somewhere in ``reach``.

    Any yaw; no point gets below ``lowest`` (m).
    """
    yaw_key, position_key = jax.random.split(key)
    yaw = jax.random.uniform(yaw_key, minval=-jnp.pi, maxval=jnp.pi)
    cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
    turned = exact_product(points, jnp.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]))
    grippers = turned[-2:]
    low = jnp.array(reach.low) - grippers.min(0)
    high = jnp.array(reach.high) - grippers.max(0)
    low = low.at[2].max(lowest - turned[:, 2].min())
    return jax.random.uniform(position_key, (3,), minval=low, maxval=jnp.maximum(high, low)), yaw


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
