"""MPPI for arms that hold a rope: rollouts on MuJoCo C, and the terms of the thesis's equation 5.2.

Towards a fixture, the cost of Wang et al. 2015 comes beside them: the angle between how the rope moves, most
of all at its keypoint, and the magnetic field of a current around the fixture's opening, which leads through
it.

What differs from the thesis's code: grasps change by planning alone, so fingers are not controlled and the
terms that move them are missing; contact is a smooth function of the exact least distance of the arms from
everything that they must not touch, in place of a count of contacts. A point of the rope that does not move
has a right angle to the field, where the code gives all of the sample the cost of a broken one.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from doojax.experiments.regrasping.world import BROKEN, World, point_of
from doojax.keys import numbered
from doojax.planning.costs import (
    THESIS_WEIGHTS,
    closeness,
    hands_reaching,
    reaching,
    rope_near,
    smoothness,
    torn,
    unstable,
)
from doojax.planning.mppi import Mppi, MppiSettings
from doojax.planning.regrasp import points_at
from doojax.planning.simulated import Tried
from doojax.robots import Robot, clearance
from doojax.simulation.state import SimState
from doojax.tasks.arms import BASE
from doojax.topology.field import magnetic_field
from doojax.types import Obstacles

PERIOD = 0.2  # s, that a control lasts: the thesis's mean
NEAR = 0.02  # m, from which on arms pay for being near to something
ALONG_FIELD = 0.25  # weight per rad
FADES = 20.0  # by exp(-20 d) points count, d from the keypoint along the rope
UPRIGHT, PITCH = 0.75, 0.2  # weight per rad, and rad: where the torso is to stay while the rope is threaded
FORESEEN = 20.0  # weight per m: of where the keypoint is after the control that TAMP looks ahead at
STILL = 1e-6  # m: a point that moves less does not move
PRESETS = {
    # where the thesis's simulations have 50 samples of 15 controls, and its real robot 32 of 7
    "quick": MppiSettings(
        samples=24, horizon=7, temperature=0.15, noise=0.187, adapt_noise=True, duration=PERIOD
    ),
    "thesis": MppiSettings(
        samples=50, horizon=15, temperature=0.15, noise=0.187, adapt_noise=True, duration=PERIOD
    ),
}


class Aim(NamedTuple):
    """What control is to do."""

    goal: Float[np.ndarray, "3"]  # of the keypoint, world frame, m
    keypoint: float  # along the rope
    loop: Float[np.ndarray, "P 3"] | None = None  # world frame, m: its field shows the way


class ArmRollouts:
    """Rollouts by the simulator, of velocities of the joints that move, `PERIOD` each; fingers stay."""

    def __init__(self, world: World):
        """Of one scene."""
        self._world = world
        self._repeats = round(PERIOD / world.scene.control_period)

    def many(self, state: SimState, controls: Float[Array, "K H U"], durations: Float[Array, "K"]) -> Tried:
        """See `doojax.planning.mppi.HostRollouts`."""
        count, horizon, _ = controls.shape
        states = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (count, *np.shape(leaf))), state)
        actions = whole(self._world, np.asarray(controls))
        repeats = self._repeats
        _, tried = self._world.simulator.rollout(states, jnp.asarray(np.repeat(actions, repeats, 1)))
        seen, near, stretch = jax.tree.map(
            lambda leaf: leaf[:, repeats::repeats], (tried.states, tried.clearance, tried.stretch)
        )
        faults = np.asarray(tried.faults).reshape(count, horizon, repeats).max(-1)
        return Tried(seen, jnp.asarray(faults), near, stretch)


def whole(world: World, controls: Float[np.ndarray, "*b U"]) -> Float[np.ndarray, "*b A"]:
    """Actions of the scene: fingers stay."""
    found = np.zeros((*controls.shape[:-1], len(world.scene.layout.driven)), np.float32)
    found[..., np.array(world.task.actuated)] = controls
    return found


def along_field(
    rope: Float[Array, "H1 N1 3"], keypoint: Float[Array, ""], loop: Float[Array, "P 3"]
) -> Float[Array, ""]:
    """Angles (rad) between a rope's motion and a loop's field, summed over steps and points.

    Points count the less, the farther along the rope they are from the keypoint: exp(-20 d).
    """
    before, moves = rope[:-1], rope[1:] - rope[:-1]
    field = jax.vmap(jax.vmap(lambda point: magnetic_field(loop, point)))(before)
    across = jnp.linalg.norm(jnp.cross(moves, field), axis=-1)
    angle = jnp.arctan2(across, (moves * field).sum(-1))
    angle = jnp.where(jnp.linalg.norm(moves, axis=-1) > STILL, angle, jnp.pi / 2)
    along = jnp.arange(rope.shape[1]) / (rope.shape[1] - 1)
    return (jnp.exp(-FADES * jnp.abs(along - keypoint)) * angle).sum()


def links_meet(points: Float[Array, "N 3"], pitch: float) -> Float[Array, "N1 3"]:
    """About where links meet, from their centres (m): exact where the rope is straight."""
    middles = (points[1:] + points[:-1]) / 2

    def end(last: Array, before: Array) -> Array:
        along = last - before
        return last + along / jnp.maximum(jnp.linalg.norm(along), 1e-9) * pitch / 2

    first, last = end(points[0], points[1]), end(points[-1], points[-2])
    return jnp.concatenate([first[None], middles, last[None]])


class ArmCost(eqx.Module):
    """All that equation 5.2 asks of one state; a `Term` of its name picks its own."""

    name: str = eqx.field(static=True)
    robot: Robot
    obstacles: Obstacles  # base's frame
    goal: Float[Array, "3"]  # world frame, m
    keypoint: Float[Array, ""]  # along the rope
    places: Float[Array, "G"]  # along the rope, NaN for nothing
    floor: float = eqx.field(static=True)
    pitch: float = eqx.field(static=True)
    begin: Float[Array, "N1 3"]  # where links meet before the first control, world frame
    loop: Float[Array, "P 3"] | None = None  # world frame

    def __call__(self, tried: Tried, controls: Float[Array, "H U"]) -> Float[Array, ""]:
        """The term's sum over a trajectory."""
        if self.name == "smoothness":
            return THESIS_WEIGHTS["smoothness"] * smoothness(tried, controls)
        if self.name == "along_field" and self.loop is not None:
            rope = jax.vmap(lambda points: links_meet(points, self.pitch))(tried.seen.points)
            rope = jnp.concatenate([self.begin[None], rope])
            return ALONG_FIELD * along_field(rope, self.keypoint, self.loop)
        return jax.vmap(getattr(self, f"_{self.name}"))(tried).sum()

    @property
    def _holding(self) -> Bool[Array, "G"]:
        return ~jnp.isnan(self.places)

    def _reaching(self, one: Tried) -> Array:
        rope = links_meet(one.seen.points, self.pitch)
        return reaching(points_at(rope, self.keypoint), self.goal)

    def _hands(self, one: Tried) -> Array:
        return hands_reaching(one.seen.grippers, self._holding, self.goal)

    def _contact(self, one: Tried) -> Array:
        near = clearance(self.robot, one.seen.joints, self.obstacles, self.floor)
        return THESIS_WEIGHTS["contacts"] * jnp.minimum(closeness(near, NEAR), 4.0)

    def _upright(self, one: Tried) -> Array:
        return UPRIGHT * jnp.abs(one.seen.joints[self.robot.joints.index("torso_pitch")] - PITCH)

    def _unstable(self, one: Tried) -> Array:
        return THESIS_WEIGHTS["unstable"] * unstable(one.faults & BROKEN)

    def _torn(self, one: Tried) -> Array:
        rope = links_meet(one.seen.points, self.pitch)
        held = jax.vmap(points_at, (None, 0))(rope, jnp.where(self._holding, self.places, 0))
        gaps = jnp.where(self._holding[:, None], held - one.seen.grippers, 0)
        return THESIS_WEIGHTS["torn"] * torn(gaps.ravel())

    def _rope_near(self, one: Tried) -> Array:
        return THESIS_WEIGHTS["rope_near"] * rope_near(one.seen.grippers, self._holding, one.seen.points)


TERMS = ("reaching", "hands", "contact", "smoothness", "unstable", "torn", "rope_near")
THREADING = ("along_field", "upright")  # more terms, towards a fixture


def controller(world: World, state: SimState, aim: Aim, settings: MppiSettings) -> Mppi:
    """MPPI from a state, with the grasps that it has."""
    rope = world.scene.rope_part.parameters
    own = world.seen_one(state).rope + np.array(BASE, np.float32)
    terms = {
        name: ArmCost(
            name,
            world.robot,
            world.obstacles,
            jnp.asarray(aim.goal, jnp.float32),
            jnp.asarray(aim.keypoint, jnp.float32),
            jnp.asarray(world.places(state), jnp.float32),
            world.floor,
            rope.length / world.scene.links,
            jnp.asarray(own),
            None if aim.loop is None else jnp.asarray(aim.loop, jnp.float32),
        )
        for name in (TERMS if aim.loop is None else TERMS + THREADING)
    }
    speed = np.asarray(world.robot.speed)[np.array(world.task.moving)]
    return Mppi(ArmRollouts(world), terms, -speed, speed, settings)


def foreseen(
    world: World, state: SimState, aim: Aim, steps: int, settings: MppiSettings, key: Key[Array, ""]
) -> float:
    """What a state costs by where so many controls bring the keypoint: the look ahead of TAMP.

    A state from which nothing can be controlled, or whose simulation breaks down, costs infinitely much.
    """
    nominal = None
    for own in numbered(key, range(steps)):
        mppi = controller(world, state, aim, settings)
        nominal, report = mppi(mppi.start() if nominal is None else nominal, state, own)
        if not np.asarray(report.weights).any():
            return float("inf")
        state, broken = world.after(state, whole(world, np.asarray(nominal.controls[0])), PERIOD)
        if broken:
            return float("inf")
        nominal = nominal.advanced()
    keypoint = point_of(world.seen_one(state).rope, aim.keypoint) + np.array(BASE)
    return FORESEEN * float(np.linalg.norm(keypoint - aim.goal))
