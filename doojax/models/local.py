"""Local frames: what a model sees stays the same wherever, and whichever way round, the rope lies.

The thesis shifts the origin to the gripper (dragging) or to the rope's mean point (two grippers). A rope on a
floor or above a table also behaves the same turned about the vertical, or mirrored in a vertical plane: a
canonical frame takes out these two as well, so that a network need not learn them.
"""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.geometry.frames import safe_norm, same_rank
from doojax.modules import Jittable
from doojax.types import RopeState

Origin = Literal["gripper", "centroid"]
Symmetry = Literal["translation", "canonical"]


class LocalFrame(Jittable):
    """A frame with a vertical z axis; if it is mirrored, its y axis points to the right of x."""

    origin: Float[Array, "3"]  # world frame, metres
    x_axis: Float[Array, "2"]  # unit, horizontal
    side: Float[Array, ""]  # 1, or -1 if mirrored

    def vectors_in(self, vectors: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
        """Differences of positions, world to local."""
        (x, y, z), (c, s) = jnp.moveaxis(vectors, -1, 0), self.x_axis
        return jnp.stack([c * x + s * y, self.side * (c * y - s * x), z], axis=-1)

    def vectors_out(self, vectors: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
        """Differences of positions, local to world."""
        (x, y, z), (c, s) = jnp.moveaxis(vectors, -1, 0), self.x_axis
        y = self.side * y
        return jnp.stack([c * x - s * y, s * x + c * y, z], axis=-1)

    def points_in(self, points: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
        """Positions, world to local."""
        points, origin = same_rank(points, self.origin)
        return self.vectors_in(points - origin)

    def heading(self, fold: int) -> Float[Array, "2"]:
        """Which way the frame points in the world, equal after turns by 2 pi / ``fold``."""
        angle = fold * jnp.arctan2(self.x_axis[1], self.x_axis[0])
        return jnp.stack([jnp.cos(angle), self.side * jnp.sin(angle)])


def local_origin(state: RopeState, origin: Origin) -> Float[Array, "3"]:
    """The first gripper, or the mean of the rope's points; world frame, metres."""
    return state.grippers[0] if origin == "gripper" else state.points.mean(0)


def local_frame(
    state: RopeState, action: Float[Array, "G 3"], origin: Origin, symmetry: Symmetry
) -> LocalFrame:
    """The frame of one state and action.

    Args:
        state: unbatched.
        action: gripper displacements, metres.
        origin: the first gripper, or the mean of the rope's points.
        symmetry: "translation" keeps the world's axes, as the thesis does. "canonical" has x along the
            horizontal direction from the first gripper to the second, or, where there is one, along the rope
            that it pulls, and is mirrored so that the summed action is to the left of x. Where x has no
            direction (a rope or a pair of grippers exactly upright) it is the world's.
    """
    at = local_origin(state, origin)
    if symmetry == "translation":
        return LocalFrame(at, jnp.array([1.0, 0.0]), jnp.array(1.0))
    if state.grippers.shape[0] > 1:
        along = state.grippers[1] - state.grippers[0]
    else:  # the held end is the last; its neighbour is far enough from the gripper to give a direction
        along = state.grippers[0] - state.points[-2]
    length = safe_norm(along[0], along[1])
    upright = length < 1e-6
    x_axis = jnp.where(upright, jnp.array([1.0, 0.0]), along[:2] / jnp.where(upright, 1.0, length))
    push = action.sum(0)
    side = jnp.where(x_axis[0] * push[1] - x_axis[1] * push[0] < 0, -1.0, 1.0)
    return LocalFrame(at, x_axis, side)


def flat(points: Float[Array, "N 3"], grippers: Float[Array, "G 3"]) -> Float[Array, "d"]:
    """One vector of d = 3 (N + G) coordinates, the rope's first."""
    return jnp.concatenate([points.reshape(-1), grippers.reshape(-1)])


def unflat(vector: Float[Array, "d"], points: int) -> tuple[Float[Array, "N 3"], Float[Array, "G 3"]]:
    """The inverse of `flat` for a rope of so many points."""
    return vector[: 3 * points].reshape(-1, 3), vector[3 * points :].reshape(-1, 3)


def chain_of(state: RopeState, midpoints: bool) -> Float[Array, "L 3"]:
    """Rope and grippers as one polyline: one gripper behind the last point, or one before and one behind.

    With midpoints, L = 2 (N + G) - 1; without, N + G.
    """
    first, last = state.grippers[:-1], state.grippers[-1:]
    chain = jnp.concatenate([first, state.points, last])
    if not midpoints:
        return chain
    between = (chain[1:] + chain[:-1]) / 2
    woven = jnp.stack([chain[:-1], between], axis=1).reshape(-1, 3)
    return jnp.concatenate([woven, last])
