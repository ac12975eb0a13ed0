"""The values that every part of doojax exchanges.

Units are metres, radians, seconds and kilograms; the world frame has z up; quaternions are (w, x, y, z).
Every class is a pytree of arrays whose leading axes ``*b`` are batch axes: write a function for one element
and batch it with `jax.vmap`.
"""

from enum import IntEnum
from typing import Annotated, Any, NamedTuple, Protocol, runtime_checkable

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


@runtime_checkable
class State(Protocol):
    """What a planner or a learner sees of the world: a pytree of arrays, such as `RopeState`.

    Batch axes come first, and a state of one element has none. Whatever has a place is a body, a point of it
    at least; what moves by itself or is moved by others stands before what actions command.
    """

    @property
    def passive(self) -> int:
        """How many of the bodies no action commands: those by which predictions are judged."""
        ...

    def bodies(self) -> Float[Array, "*b K 3"]:
        """Where all bodies are, world frame, metres; the passive ones first."""
        ...

    def moved(self, motion: Motion) -> "State":
        """The same state elsewhere."""
        ...


class RopeState(eqx.Module):
    """What a planner or a learner sees of the world: points along the rope and the grippers' positions."""

    points: Float[Array, "*b N 3"]  # world frame, metres; index 0 is the rope's first link
    grippers: Float[Array, "*b G 3"]  # world frame, metres

    @property
    def passive(self) -> int:
        """The rope's points."""
        return self.points.shape[-2]

    def bodies(self) -> Float[Array, "*b NG 3"]:
        """The rope's points and then the grippers, metres."""
        return jnp.concatenate([self.points, self.grippers], axis=-2)

    def moved(self, motion: Motion) -> "RopeState":
        """The same rope, held alike, elsewhere."""
        return RopeState(points=motion.points(self.points), grippers=motion.points(self.grippers))


class ArmsState(RopeState):
    """The same, and the joints of the arms whose tools are the grippers."""

    joints: Float[Array, "*b J"]  # rad or m, in the order of `doojax.robots.Robot.joints`

    def moved(self, motion: Motion) -> "ArmsState":
        """The same rope, held alike, elsewhere, by arms whose base moves along."""
        return ArmsState(motion.points(self.points), motion.points(self.grippers), self.joints)


class PushingState(eqx.Module):
    """What is seen of rigid bodies that a hand pushes over a table."""

    positions: Float[Array, "*b N 3"]  # of their centres, world frame, metres
    velocities: Float[Array, "*b N 3"]  # m/s
    hand: Float[Array, "*b 3"]  # world frame, metres

    @property
    def passive(self) -> int:
        """All but the hand."""
        return self.positions.shape[-2]

    def bodies(self) -> Float[Array, "*b K 3"]:
        """All places: the bodies', then the hand's."""
        return jnp.concatenate([self.positions, self.hand[..., None, :]], axis=-2)

    def moved(self, motion: Motion) -> "PushingState":
        """The same elsewhere."""
        return PushingState(
            motion.points(self.positions), motion.vectors(self.velocities), motion.points(self.hand)
        )


WHOLE = 0.5  # m, by which the gauge of what was poured rises for all of a fluid
SPILT = 1.25  # m, by which that of what was spilled does: 5 % are as far as 12.5 % of what is poured
GAUGES = ((0.0, -1.0, 0.0), (0.0, -1.2, 0.0))  # m, where they stand, from the receiver: in nobody's way


class PouringState(eqx.Module):
    """What is seen of a container that pours into another, along x, turning about y.

    Volumes are seen as gauges that stand beside the receiver, so that metric, goals and errors have metres: a
    gauge is a body that rises with what was poured, another with what was spilled.
    """

    container: Float[Array, "*b 3"]  # the middle of its inner floor, world frame, metres
    angle: Float[Array, "*b"]  # from upright towards +x, rad
    receiver: Float[Array, "*b 3"]  # the same of the other, which stands upright
    volumes: Float[Array, "*b 2"]  # in the receiver and in the container, parts of the whole
    size: Float[Array, "*b 2"]  # of the container: outer width along x, and height, metres

    @property
    def passive(self) -> int:
        """The gauges and the container's place, which may have been stopped by what it met."""
        return 3

    @property
    def spilled(self) -> Float[Array, "*b"]:
        """What is in neither, in the air or on the floor, as a part of the whole."""
        return jnp.clip(1 - self.volumes.sum(-1), 0.0, 1.0)

    def bodies(self) -> Float[Array, "*b 7 3"]:
        """The gauges of what was poured and spilled, the container's place, and its corners in the plane."""
        up = jnp.array([0.0, 0.0, 1.0])
        heights = WHOLE * self.volumes[..., :1], SPILT * self.spilled[..., None]
        gauges = [
            self.receiver + jnp.array(at) + up * height for at, height in zip(GAUGES, heights, strict=True)
        ]
        return jnp.stack([*gauges, self.container, *self.corners()], axis=-2)

    def corners(self) -> list[Float[Array, "*b 3"]]:
        """Of the container's floor and rim, left and right, in the plane of its middle, metres."""
        cosine, sine = jnp.cos(self.angle)[..., None], jnp.sin(self.angle)[..., None]
        across = jnp.concatenate([cosine, jnp.zeros_like(cosine), -sine], axis=-1)
        upwards = jnp.concatenate([sine, jnp.zeros_like(cosine), cosine], axis=-1)
        half, height = self.size[..., :1] / 2, self.size[..., 1:]
        return [
            self.container + side * half * across + level * height * upwards
            for side, level in ((-1, 0), (1, 0), (-1, 1), (1, 1))
        ]

    def moved(self, motion: Motion) -> "PouringState":
        """The same elsewhere; turned about the vertical by nothing but what keeps it in its plane."""
        return PouringState(
            motion.points(self.container), self.angle, motion.points(self.receiver), self.volumes, self.size
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

    state: Any  # a State, itself predicted, but for the first of a plan
    action: Float[Array, "..."]  # such as gripper displacements, metres; batch axes first
    next_state: Any  # a State: the prediction
    uncertainty: Float[Array, "*b"]  # the dynamics model's second result, see doojax.models.protocols


class Judgement(NamedTuple):
    """What a judge of transitions says of one, see doojax.models.protocols."""

    score: Float[Array, "*b"]  # in the judge's own unit
    accepted: Bool[Array, "*b"]
    possible: Bool[Array, "*b"]  # false where it contradicts physics: then it is not accepted by luck, either


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
