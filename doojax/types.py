"""The values that every part of doojax exchanges.

Units are metres, radians, seconds and kilograms; the world frame has z up; quaternions are (w, x, y, z).
Every class is a pytree of arrays whose leading axes ``*b`` are batch axes: write a function for one element
and batch it with `jax.vmap`.
"""

from enum import IntEnum
from typing import Annotated, Any, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int
from msgspec import Meta

# What a network's config may hold: a file that asks for more is damaged, and must not be tried.
Size = Annotated[int, Meta(ge=1, le=65_536)]
Depth = Annotated[int, Meta(ge=0, le=64)]  # of what is built one after the other


@runtime_checkable
class Motion(Protocol):
    """What becomes of places and directions, such as `doojax.geometry.motion.RigidMotion`."""

    def points(self, points: Float[Array, "*p 3"]) -> Float[Array, "*p 3"]:
        """Places, m: turned and moved."""
        ...

    def vectors(self, vectors: Float[Array, "*p 3"]) -> Float[Array, "*p 3"]:
        """Directions, velocities, displacements: turned only."""
        ...


class RopeState(eqx.Module):
    """What a planner or a learner sees of the world: points along the rope and the grippers' positions."""

    points: Float[Array, "*b N 3"]  # world frame, metres; index 0 is the rope's first link
    grippers: Float[Array, "*b G 3"]  # world frame, metres

    def moved(self, motion: Motion) -> "RopeState":
        """The same rope, held alike, elsewhere."""
        return RopeState(points=motion.points(self.points), grippers=motion.points(self.grippers))


class PushingState(eqx.Module):
    """What is seen of rigid bodies that a hand pushes over a table."""

    positions: Float[Array, "*b N 3"]  # of their centres, world frame, metres
    velocities: Float[Array, "*b N 3"]  # m/s
    hand: Float[Array, "*b 3"]  # world frame, metres

    def bodies(self) -> Float[Array, "*b K 3"]:
        """All places: the bodies', then the hand's."""
        return jnp.concatenate([self.positions, self.hand[..., None, :]], axis=-2)

    def moved(self, motion: Motion) -> "PushingState":
        """The same elsewhere."""
        return PushingState(
            motion.points(self.positions), motion.vectors(self.velocities), motion.points(self.hand)
        )


class ShapeKind(IntEnum):
    """How `Obstacles.half_size` is read."""

    BOX = 0  # half extents along the body's x, y, z
    CAPSULE = 1  # (radius, radius, half length of the straight part), along z
    CYLINDER = 2  # (radius, radius, half height), along z


class Obstacles(eqx.Module):
    """A fixed number M of rigid primitives; unused or parked ones have ``active`` false."""

    kind: Int[Array, "*b M"]  # a ShapeKind
    centre: Float[Array, "*b M 3"]  # world frame, metres
    quaternion: Float[Array, "*b M 4"]  # body to world, unit, (w, x, y, z)
    half_size: Float[Array, "*b M 3"]  # metres, see ShapeKind
    active: Bool[Array, "*b M"]


class Transition(eqx.Module):
    """One predicted step: what an action is thought to do."""

    state: RopeState  # itself predicted, but for the first of a plan
    action: Float[Array, "*b G 3"]  # gripper displacements, metres
    next_state: RopeState  # the prediction
    uncertainty: Float[Array, "*b"]  # the dynamics model's second result, see doojax.models.protocols


class Trajectory(eqx.Module):
    """T control periods: T + 1 states and the T actions between them."""

    states: Any  # such as a RopeState: points [*b, T+1, N, 3], grippers [*b, T+1, G, 3]
    actions: Float[Array, "..."]  # [*b, T, *action]: of hands their displacements, metres, [G, 3]
    faults: Int[Array, "*b T"]  # bit set of doojax.simulation.Fault, per control period
    clearance: Float[Array, "*b T1"]  # m, least distance of rope and grippers to an obstacle, per state
    stretch: Float[Array, "*b T1"]  # by what fraction of its length the rope, held or not, is too long


class Verdict(IntEnum):
    """What became of an augmentation; the `verdict` of each row of an augmented data set."""

    ORIGINAL = 0  # no augmentation: the example itself
    ACCEPTED = 1
    BOX = 2  # rejected: it would leave the workspace
    INVALID = 3  # rejected: the transform is none for this task
    OCCUPANCY = 4  # rejected: something would touch an obstacle that did not, or the other way round
    DISTANCE = 5  # rejected: what was near an obstacle would be far, or the other way round
    ROBOT = 6  # rejected: the robot cannot follow
    NO_PROGRESS = 7  # rejected: it got no further than the least motion from where it was
    NOTHING_MOVED = 8  # refused: nothing moved in the example
    OUTSIDE = 9  # refused: the example itself leaves the workspace
    FAULTY = 10  # refused: the example has a fault or values that are missing
