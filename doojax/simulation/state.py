"""The state of a simulation: the same few arrays for every engine, so that a state moves between them."""

from collections.abc import Callable
from enum import IntFlag
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from doojax.simulation.scenes import Scene
from doojax.types import Obstacles, Trajectory

MAX_VELOCITY = 1000.0  # m/s or rad/s: beyond it a state counts as unstable


class Fault(IntFlag):
    """What went wrong in a control period; the bits of `SimState.faults` and `Trajectory.faults`."""

    NOT_FINITE = 1  # NaN or infinity in the state
    UNSTABLE = 2  # a joint moves faster than MAX_VELOCITY
    CONTACTS_DROPPED = 4  # MJX met more contacts than the scene's max_contact_points
    SCENE_OVERFULL = 8  # no room was found for an obstacle: it stays parked
    PASSED_THROUGH = 16  # what moves went into an obstacle or through it: a link's axis, a particle's centre
    NEIGHBOURS_DROPPED = 32  # a particle of a fluid met more others than there is room for
    STEP_TOO_LONG = 64  # a particle of a fluid was so fast that it could have passed a wall in one step


class SimState(eqx.Module):
    """All that a simulation needs to go on, and nothing else."""

    qpos: Float[Array, "*b nq"]
    qvel: Float[Array, "*b nv"]
    commanded: Float[Array, "..."]  # of hands: where each was last sent, world frame, m, [*b, G, D]
    obstacle_position: Float[Array, "*b B 3"]  # of the scene's obstacle bodies, world frame, m
    obstacle_quaternion: Float[Array, "*b B 4"]
    holding: Bool[Array, "*b H"]  # does each gripper that has a link hold it?
    faults: Int[Array, "*b"]  # Fault bits of the last control period
    model_fields: dict[str, Any]  # model values that differ by element; empty for the scene's own rope


def at_rest(
    scene: Scene, qpos: Float[Array, "nq"], position: Float[Array, "B 3"], quaternion: Float[Array, "B 4"]
) -> SimState:
    """All at rest, the B obstacle bodies at the given poses (m), the rope held by each gripper with a link.

    Hands that may hold it anywhere hold nothing: see `doojax.simulation.grasps`.
    """
    layout = scene.layout
    return SimState(
        qpos=qpos,
        qvel=jnp.zeros(layout.nv, qpos.dtype),
        commanded=qpos[layout.driven],
        obstacle_position=position,
        obstacle_quaternion=quaternion,
        holding=jnp.arange(len(layout.holds)) < len(layout.places[layout.driver].holds),
        faults=jnp.array(0, dtype=jnp.int32),
        model_fields={},
    )


Start = Callable[[Array], SimState]
"""Draws a start from a random key."""


@runtime_checkable
class Simulator(Protocol):
    """One scene on one engine. `reset`, `step` and `observe` take one element; `rollout` takes a batch."""

    scene: Scene

    def reset(self, key: Array) -> SimState:
        """A start drawn from the task's distribution."""
        ...

    def step(self, state: SimState, action: Float[Array, "*action"]) -> SimState:
        """One control period: move each hand by ``action`` [G, 3] (m, world axes), at bounded speed."""
        ...

    def observe(self, state: SimState) -> Any:
        """What learners and planners see of it: such as a `doojax.types.RopeState`."""
        ...

    def observations(self, states: SimState) -> Any:
        """A batch of `doojax.simulation.layout.Observation`: also the links' directions."""
        ...

    def obstacles(self, state: SimState) -> Obstacles:
        """The primitives of the obstacles where they are."""
        ...

    def rollout(self, states: SimState, actions: Float[Array, "B T *action"]) -> tuple[SimState, Trajectory]:
        """T control periods of B elements: the bulk path. Returns the last states and all that was seen."""
        ...


def find_faults(qpos: Float[Array, "*b nq"], qvel: Float[Array, "*b nv"]) -> Int[Array, "*b"]:
    """Fault bits that show in a state."""
    finite = jnp.isfinite(qpos).all(-1) & jnp.isfinite(qvel).all(-1)
    unstable = ~(jnp.abs(qvel) < MAX_VELOCITY).all(-1)
    return jnp.where(finite, 0, int(Fault.NOT_FINITE)) + jnp.where(unstable, int(Fault.UNSTABLE), 0)
