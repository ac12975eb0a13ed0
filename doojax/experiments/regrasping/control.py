"""MPPI for arms that hold a rope: rollouts on MuJoCo C, and the terms of the thesis's equation 5.2.

What differs from the thesis's code: grasps change by planning alone, so fingers are not controlled and the
terms that move them are missing; contact is a smooth function of the exact least distance of the arms from
everything that they must not touch, in place of a count of contacts.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.experiments.regrasping.world import BROKEN, World
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
from doojax.types import Obstacles

PERIOD = 0.2  # s, that a control lasts: the thesis's mean
NEAR = 0.02  # m, from which on arms pay for being near to something
PRESETS = {
    # where the thesis's simulations have 50 samples of 15 controls, and its real robot 32 of 7
    "quick": MppiSettings(
        samples=24, horizon=7, temperature=0.15, noise=0.187, adapt_noise=True, duration=PERIOD
    ),
    "thesis": MppiSettings(
        samples=50, horizon=15, temperature=0.15, noise=0.187, adapt_noise=True, duration=PERIOD
    ),
}


class ArmRollouts:
    """Rollouts by the simulator, of velocities of the joints that move, `PERIOD` each; fingers stay."""

    def __init__(self, world: World):
        """Of one scene."""
        self._world = world
        self._repeats = round(PERIOD / world.scene.control_period)
        self._at = np.array(world.task.actuated)

    def many(self, state: SimState, controls: Float[Array, "K H U"], durations: Float[Array, "K"]) -> Tried:
        """See `doojax.planning.mppi.HostRollouts`."""
        count, horizon, _ = controls.shape
        states = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (count, *np.shape(leaf))), state)
        actions = np.zeros((count, horizon, len(self._world.scene.layout.driven)), np.float32)
        actions[..., self._at] = np.asarray(controls)
        repeats = self._repeats
        _, tried = self._world.simulator.rollout(states, jnp.asarray(np.repeat(actions, repeats, 1)))
        seen, near, stretch = jax.tree.map(
            lambda leaf: leaf[:, repeats::repeats], (tried.states, tried.clearance, tried.stretch)
        )
        faults = np.asarray(tried.faults).reshape(count, horizon, repeats).max(-1)
        return Tried(seen, jnp.asarray(faults), near, stretch)


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
    keypoint: float
    places: Float[Array, "G"]  # along the rope, NaN for nothing
    floor: float = eqx.field(static=True)
    pitch: float = eqx.field(static=True)

    def __call__(self, tried: Tried, controls: Float[Array, "H U"]) -> Float[Array, ""]:
        """The term's sum over a trajectory."""
        if self.name == "smoothness":
            return THESIS_WEIGHTS["smoothness"] * smoothness(tried, controls)
        return jax.vmap(getattr(self, f"_{self.name}"))(tried).sum()

    @property
    def _holding(self) -> Bool[Array, "G"]:
        return ~jnp.isnan(self.places)

    def _reaching(self, one: Tried) -> Array:
        rope = links_meet(one.seen.points, self.pitch)
        return reaching(points_at(rope, jnp.asarray(self.keypoint)), self.goal)

    def _hands(self, one: Tried) -> Array:
        return hands_reaching(one.seen.grippers, self._holding, self.goal)

    def _contact(self, one: Tried) -> Array:
        near = clearance(self.robot, one.seen.joints, self.obstacles, self.floor)
        return THESIS_WEIGHTS["contacts"] * jnp.minimum(closeness(near, NEAR), 4.0)

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


def controller(world: World, places: tuple[float, ...], goal: np.ndarray, settings: MppiSettings) -> Mppi:
    """MPPI that brings the keypoint to ``goal`` (world frame, m) with the present grasp."""
    rope = world.scene.rope_part.parameters
    terms = {
        name: ArmCost(
            name,
            world.robot,
            world.obstacles,
            jnp.asarray(goal, jnp.float32),
            world.task.keypoint,
            jnp.asarray(places, jnp.float32),
            world.floor,
            rope.length / world.scene.links,
        )
        for name in TERMS
    }
    speed = np.asarray(world.robot.speed)[np.array(world.task.moving)]
    return Mppi(ArmRollouts(world), terms, -speed, speed, settings)
