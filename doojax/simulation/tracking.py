"""A stand-in for a real robot: hands that go astray, and a rope that a camera sees inexactly and in part.

Learners and planners get what such a robot knows: where its hands were sent, where a tracker has the rope.
The simulation goes on with what is true. Errors are correlated in time, as those of calibration and tracking
are, and do not add up: a hand that is sent to a place is always about as far from it.
"""

from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, UInt32

from doojax.geometry.segment_sdf import segment_signed_distance
from doojax.simulation.layout import Observation
from doojax.simulation.scenes import Scene, obstacles_at
from doojax.simulation.state import SimState, Simulator
from doojax.types import Obstacles, RopeState, Trajectory

TINY = 1e-9  # m


@dataclass(frozen=True)
class Tracking:
    """How far off a robot is; the defaults are exact. Thesis, 4.4.5: hands some 5 cm off."""

    hand_error: float = 0.0  # m, root mean square, of a hand from where it was sent
    point_error: float = 0.0  # m, root mean square, of a point of the rope from where it is seen
    correlation: float = 0.8  # of either, from one control period to the next
    camera: tuple[float, float, float] | None = None
    """m, world frame: what an obstacle hides from it is not seen; None sees all."""

    def __post_init__(self):
        """Refuse what is no error."""
        for name in ("hand_error", "point_error"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 to 1 m")
        if not 0 <= self.correlation < 1:
            raise ValueError(f"correlation is {self.correlation}, expected 0 or more and less than 1")

    @property
    def exact(self) -> bool:
        """Is all where it should be, and seen?"""
        return not self.hand_error and not self.point_error and self.camera is None


EXACT = Tracking()


class TrackedState(SimState):
    """What is true, and what of it is known."""

    astray: Float[Array, "*b G 3"]  # m, hands from where they were sent
    blur: Float[Array, "*b N 3"]  # m, points that can be seen from where they are
    estimate: Float[Array, "*b N 3"]  # m, world frame, of the rope's points
    random: UInt32[Array, "*b 2"]  # a key as data: a state may be gone on from twice

    @property
    def simulation(self) -> SimState:
        """What is true, alone."""
        return SimState(**{one.name: getattr(self, one.name) for one in fields(SimState)})


class Tracked:
    """A `doojax.simulation.state.Simulator` of a rope and hands, whose states are `TrackedState`."""

    def __init__(self, simulator: Simulator, tracking: Tracking):
        """Wrap a simulator.

        Raises:
            ValueError: its scene has no rope.
        """
        if simulator.scene.rope is None:
            raise ValueError("only a rope can be tracked, and the scene has none")
        self.simulator, self.tracking = simulator, tracking
        self.scene: Scene = simulator.scene

    def begun(self, states: SimState, keys: Key[Array, "B"]) -> TrackedState:
        """A batch of states, all of the rope seen."""
        true = self.simulator.observations(states).state
        return _begun(self.tracking, states, true, keys)

    def truth(self, states: TrackedState) -> RopeState:
        """Where hands and ropes of a batch are."""
        return self.simulator.observations(states.simulation).state

    def reset(self, key: Key[Array, ""]) -> TrackedState:
        """See `Simulator`."""
        own, other = jax.random.split(key)
        state = self.simulator.reset(own)
        return _begun_one(self.tracking, state, self.simulator.observe(state), other)

    def step(self, state: Any, action: Float[Array, "G 3"]) -> TrackedState:
        """See `Simulator`."""
        keys, later, astray = _drawn(self.tracking, state, 1)
        after = self.simulator.step(state.simulation, action + astray[1] - astray[0])
        points = self.simulator.observe(after).points[None]
        blur, estimate = _sighted(self.tracking, self.scene, state, after, points, keys)
        return TrackedState(**vars(after), astray=astray[1], blur=blur, estimate=estimate[0], random=later)

    def observe(self, state: Any) -> RopeState:
        """See `Simulator`: what is known."""
        return _known(self.simulator.observe(state.simulation), state)

    def observations(self, states: Any) -> Observation:
        """See `Simulator`: what is known; half links are those that are true."""
        found: Observation = self.simulator.observations(states.simulation)
        known = (_known(found.state, states), found.hands - states.astray)
        return eqx.tree_at(lambda one: (one.state, one.hands), found, known)

    def obstacles(self, state: Any) -> Obstacles:
        """See `Simulator`."""
        return self.simulator.obstacles(state)

    def rollout(self, states: Any, actions: Float[Array, "B T G 3"]) -> tuple[TrackedState, Trajectory]:
        """See `Simulator`: the trajectory has what is known, and the actions that were asked for."""
        keys, later, astray = _drawn_many(self.tracking, states, actions.shape[1])
        executed = actions + astray[:, 1:] - astray[:, :-1]
        last, true = self.simulator.rollout(states.simulation, executed)
        points = true.states.points[:, 1:]
        blur, estimates = _sighted_many(self.tracking, self.scene, states, last, points, keys)
        seen = RopeState(
            jnp.concatenate([states.estimate[:, None], estimates], axis=1), true.states.grippers - astray
        )
        known = eqx.tree_at(lambda one: (one.states, one.actions), true, (seen, actions))
        after = TrackedState(
            **vars(last), astray=astray[:, -1], blur=blur, estimate=estimates[:, -1], random=later
        )
        return after, known


def tracked(simulator: Simulator, tracking: Tracking) -> Simulator:
    """The simulator as a robot that is so far off knows it; itself where all is exact."""
    return simulator if tracking.exact else Tracked(simulator, tracking)


def hidden(
    camera: tuple[float, float, float], obstacles: Obstacles, points: Float[Array, "N 3"], radius: float
) -> Bool[Array, "N"]:
    """Which points of a rope of this radius (m) are behind an obstacle. All in the world frame, m."""
    eye = jnp.broadcast_to(jnp.array(camera, points.dtype), points.shape)
    towards = eye - points
    away = jnp.linalg.norm(towards, axis=-1, keepdims=True)
    surface = points + towards / jnp.maximum(away, TINY) * jnp.minimum(2 * radius, away)
    return segment_signed_distance(obstacles, eye, surface) < 0


def followed(
    before: Float[Array, "N 3"], now: Float[Array, "N 3"], unseen: Bool[Array, "N"]
) -> Float[Array, "N 3"]:
    """A tracker's next estimate: points that are seen are where they are seen; others move as those beside
    them do, between their neighbours by how near along the rope each is; all stay where nothing is seen."""
    places = jnp.arange(len(before), dtype=before.dtype)
    order = jnp.argsort(unseen, stable=True)  # those that are seen first, in their order
    count = (~unseen).sum()
    last = order[jnp.maximum(count - 1, 0)]
    chosen = jnp.where(jnp.arange(len(order)) < count, order, last)
    moved = (now - before)[chosen]
    along = jax.vmap(lambda values: jnp.interp(places, places[chosen], values), 1, 1)(moved)
    return jnp.where(unseen[:, None], before + jnp.where(count > 0, along, 0.0), now)


def _next(
    correlation: float, error: float, axes: int, now: Float[Array, "K 3"], key: Key[Array, ""]
) -> Float[Array, "K 3"]:
    """An error a period later, of this root mean square (m), along the first so many axes."""
    fresh = error / jnp.sqrt(axes) * jax.random.normal(key, now.shape, now.dtype)
    fresh = jnp.where(jnp.arange(3) < axes, fresh, 0.0)
    return correlation * now + jnp.sqrt(1 - correlation**2) * fresh


@partial(jax.jit, static_argnums=(0, 2))
def _drawn(
    tracking: Tracking, state: TrackedState, periods: int
) -> tuple[UInt32[Array, "T 2"], UInt32[Array, "2"], Float[Array, "T1 G 3"]]:
    """A key of each period, one for what comes after, and hands' errors before and after each period."""
    axes = state.commanded.shape[-1]  # a hand that moves in the plane goes astray there

    def period(carry: tuple[Array, Array], _: None) -> tuple:
        astray, key = carry
        own, hands, later = jax.random.split(key, 3)
        after = _next(tracking.correlation, tracking.hand_error, axes, astray, hands)
        return (after, later), (jax.random.key_data(own), after)

    begin = (state.astray, jax.random.wrap_key_data(state.random))
    (_, last), (keys, astray) = jax.lax.scan(period, begin, None, periods)
    return keys, jax.random.key_data(last), jnp.concatenate([state.astray[None], astray])


_drawn_many = jax.jit(jax.vmap(_drawn, (None, 0, None)), static_argnums=(0, 2))


@partial(jax.jit, static_argnums=(0, 1))
def _sighted(
    tracking: Tracking,
    scene: Scene,
    state: TrackedState,
    last: SimState,
    points: Float[Array, "T N 3"],
    keys: UInt32[Array, "T 2"],
) -> tuple[Float[Array, "N 3"], Float[Array, "T N 3"]]:
    """The last error of points that are seen, and the estimates after each period; obstacles stand still."""
    obstacles = obstacles_at(scene, last.obstacle_position, last.obstacle_quaternion)
    radius = scene.rope_part.parameters.radius

    def period(carry: tuple[Array, Array], given: tuple[Array, Array]) -> tuple:
        (blur, estimate), (true, key) = carry, given
        own = jax.random.wrap_key_data(key)
        blur = _next(tracking.correlation, tracking.point_error, 3, blur, own)
        if tracking.camera is None:
            unseen = jnp.zeros(len(true), bool)
        else:
            unseen = hidden(tracking.camera, obstacles, true, radius)
        estimate = followed(estimate, true + blur, unseen)
        return (blur, estimate), estimate

    (blur, _), estimates = jax.lax.scan(period, (state.blur, state.estimate), (points, keys))
    return blur, estimates


_sighted_many = jax.jit(jax.vmap(_sighted, (None, None, 0, 0, 0, 0)), static_argnums=(0, 1))


def _begun_one(tracking: Tracking, state: SimState, true: Any, key: Key[Array, ""]) -> TrackedState:
    for_hands, for_points, later = jax.random.split(key, 3)
    axes, none = state.commanded.shape[-1], jnp.zeros_like
    astray = _next(0.0, tracking.hand_error, axes, none(true.grippers), for_hands)
    blur = _next(0.0, tracking.point_error, 3, none(true.points), for_points)
    known, data = true.points + blur, jax.random.key_data(later)
    return TrackedState(**vars(state), astray=astray, blur=blur, estimate=known, random=data)


_begun = jax.jit(jax.vmap(_begun_one, (None, 0, 0, 0)), static_argnums=0)


def _known(true: RopeState, state: TrackedState) -> RopeState:
    return RopeState(state.estimate, true.grippers - state.astray)
