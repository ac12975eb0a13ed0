"""A simulator as dynamics: planning with the truth, which says what could be solved at all."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from doojax.models.protocols import Dynamics
from doojax.modules import Jittable
from doojax.planning.rrt import HostDynamics
from doojax.simulation.scenes import parked_poses
from doojax.simulation.state import SimState, Simulator
from doojax.types import Motion, Obstacles, PouringState, RopeState, State


class SimulatedState(RopeState):
    """A rope with all that its simulation needs to go on."""

    simulation: SimState


class SimulatedPouring(PouringState):
    """A container that pours with all that its simulation needs to go on."""

    simulation: SimState


class SimulatedBodies(eqx.Module):
    """Any other state with all that its simulation needs to go on."""

    seen: Any  # a State
    simulation: SimState

    @property
    def passive(self) -> int:
        """As of what is seen."""
        return self.seen.passive

    def bodies(self) -> Float[Array, "*b K 3"]:
        """As of what is seen."""
        return self.seen.bodies()

    def moved(self, motion: Motion) -> State:
        """What is seen elsewhere, without its simulation."""
        return self.seen.moved(motion)


class Simulated(Jittable):
    """One step of a simulator that is pure, as `Dynamics` of states with it; obstacles are in the state."""

    simulator: Simulator

    def __call__(
        self, obstacles: Obstacles, state: State, action: Float[Array, "..."]
    ) -> tuple[State, Float[Array, ""]]:
        """The next state, NaN where the simulation broke down; no uncertainty."""
        after = self.simulator.step(_simulation(state), action)
        return _seen(after, self.simulator.observe(after)), jnp.zeros(())


class HostSimulated:
    """The same for a simulator that runs outside of jit, in batches."""

    def __init__(self, simulator: Simulator):
        """Wrap ``simulator``."""
        self._simulator = simulator

    def many(
        self, obstacles: Obstacles, states: State, actions: Float[Array, "R L ..."]
    ) -> tuple[State, Float[Array, "R L"]]:
        """The next states; see `Simulated`."""
        shape = actions.shape[:2]
        count = shape[0] * shape[1]  # not -1, which fields without a size refuse, such as what nobody holds
        flat = jax.tree.map(lambda leaf: leaf.reshape(count, *leaf.shape[2:]), _simulation(states))
        last, trajectory = self._simulator.rollout(flat, actions.reshape(count, 1, *actions.shape[2:]))
        seen = jax.tree.map(lambda leaf: leaf[:, -1], trajectory.states)
        after = jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), _seen(last, seen))
        return after, jnp.zeros(shape)


def simulated(simulator: Simulator) -> Dynamics | HostDynamics:
    """The dynamics of any simulator: inside jit if it is a pytree, else in batches outside."""
    return Simulated(simulator) if isinstance(simulator, eqx.Module) else HostSimulated(simulator)


class Tried(eqx.Module):
    """What rollouts of MPPI led to, after each control."""

    seen: Any  # [K, H, ...], such as a `doojax.types.RopeState`
    faults: Int[Array, "*b H"]  # see `doojax.simulation.state.Fault`
    clearance: Float[Array, "*b H"]  # m, see `doojax.types.Trajectory`
    stretch: Float[Array, "*b H"]


class SimulatedRollouts:
    """Rollouts for `doojax.planning.mppi` by a simulator, outside of jit; a control is a flat action.

    Each control lasts one control period of the scene: samples' durations do not count.
    """

    def __init__(self, simulator: Simulator, action: tuple[int, ...]):
        """Wrap ``simulator``, whose actions have the shape ``action``."""
        self._simulator, self._action = simulator, action

    def many(self, state: SimState, controls: Float[Array, "K H U"], durations: Float[Array, "K"]) -> Tried:
        """See `doojax.planning.mppi.HostRollouts`.

        Of a batch of R states, such as of one scene with the ropes that may be meant
        (`doojax.tasks.ropes.carrying`), every sample is rolled out from each: to states [K, R, H, ...], for
        `Mppi.risk`.
        """
        if np.ndim(state.qpos) == 2:
            return self._from_each(state, controls, durations)
        count, horizon = controls.shape[:2]
        states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), state)
        return self._tried(states, controls.reshape(count, horizon, *self._action))

    def _from_each(self, states: SimState, controls: Array, durations: Array) -> Tried:
        samples, ropes = len(controls), len(states.qpos)
        every = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (samples, *leaf.shape)).reshape(-1, *leaf.shape[1:]), states
        )
        actions = jnp.repeat(controls, ropes, axis=0).reshape(-1, controls.shape[1], *self._action)
        found = self._tried(every, actions)
        return jax.tree.map(lambda leaf: leaf.reshape(samples, ropes, *leaf.shape[1:]), found)

    def _tried(self, states: SimState, actions: Array) -> Tried:
        _, trajectory = self._simulator.rollout(states, actions)
        seen, clearance, stretch = jax.tree.map(
            lambda leaf: leaf[:, 1:], (trajectory.states, trajectory.clearance, trajectory.stretch)
        )
        return Tried(seen, trajectory.faults, clearance, stretch)


def simulated_start(simulator: Simulator, states: SimState, *, without_obstacles: bool = False) -> State:
    """A batch of states to plan from; without obstacles the dynamics are the unconstrained ones, exact."""
    seen = simulator.observations(states).state
    if without_obstacles:
        position, quaternion = parked_poses(states.obstacle_position.shape[-2])
        states = eqx.tree_at(
            lambda s: (s.obstacle_position, s.obstacle_quaternion),
            states,
            (
                jnp.broadcast_to(position, states.obstacle_position.shape),
                jnp.broadcast_to(quaternion, states.obstacle_quaternion.shape),
            ),
        )
    return _with(seen, states)


def _simulation(state: State) -> SimState:
    if not isinstance(state, SimulatedState | SimulatedPouring | SimulatedBodies):
        raise ValueError(
            f"planning with a simulator begins at simulated_start(...), got a plain {type(state).__name__}"
        )
    return state.simulation


def _seen(after: SimState, seen: State) -> State:
    sound = after.faults == 0

    def known(leaf: Array) -> Array:
        return jnp.where(sound.reshape(*sound.shape, *[1] * (leaf.ndim - sound.ndim)), leaf, jnp.nan)

    return _with(jax.tree.map(known, seen), after)


def _with(seen: State, simulation: SimState) -> State:
    if isinstance(seen, RopeState):
        return SimulatedState(points=seen.points, grippers=seen.grippers, simulation=simulation)
    if isinstance(seen, PouringState):
        parts = seen.container, seen.angle, seen.receiver, seen.volumes, seen.size
        return SimulatedPouring(*parts, simulation=simulation)
    return SimulatedBodies(seen, simulation)
