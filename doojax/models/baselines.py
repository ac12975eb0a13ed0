"""Judges of reliability that learn nothing."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.geometry.sdf import FAR, segment_signed_distance, signed_distance
from doojax.models.local import chain_of
from doojax.models.protocols import Reliability
from doojax.modules import Jittable
from doojax.types import Obstacles, RopeState

ROUNDING = 1e-5  # m


class Always(Jittable):
    """Accepts every transition: planning without a classifier."""

    threshold: float = 0.5

    def __call__(
        self,
        obstacles: Obstacles,
        state: RopeState,
        action: Float[Array, "G 3"],
        next_state: RopeState,
        uncertainty: Float[Array, ""],
    ) -> Float[Array, ""]:
        """One."""
        return jnp.ones(())


class Stricter(Jittable):
    """Another judge's scores with a threshold of one's own."""

    judge: Reliability
    threshold: float

    def __call__(
        self,
        obstacles: Obstacles,
        state: RopeState,
        action: Float[Array, "G 3"],
        next_state: RopeState,
        uncertainty: Float[Array, ""],
    ) -> Float[Array, ""]:
        """The other judge's score."""
        return self.judge(obstacles, state, action, next_state, uncertainty)


class CollisionChecker(Jittable):
    """Accepts a transition if rope and grippers touch no obstacle, at its end and on the way there.

    The released code marks the voxels within ``margin`` = 2 cm of an obstacle and looks up the rope's points
    there, after the motion. Here the distance is exact and taken along the straight links, so that nothing
    slips between two points, and along the straight ways of all points and grippers, so that nothing cuts a
    corner whose two ends are clear; ``points_only`` looks at the rope's points alone, as they did. A way
    counts where it comes nearer to an obstacle than where it begins, so that a rope that touches one already
    may leave it.
    """

    margin: float = 0.02  # m, that the rope's axis and the grippers must keep from every obstacle
    points_only: bool = eqx.field(static=True, default=False)

    @property
    def threshold(self) -> float:
        """The margin (m)."""
        return self.margin

    def __call__(
        self,
        obstacles: Obstacles,
        state: RopeState,
        action: Float[Array, "G 3"],
        next_state: RopeState,
        uncertainty: Float[Array, ""],
    ) -> Float[Array, ""]:
        """The least distance to an obstacle of the rope's axis and the grippers, metres."""
        if self.points_only:
            return signed_distance(obstacles, next_state.points).min()
        begin, end = chain_of(state, midpoints=False), chain_of(next_state, midpoints=False)
        starts, ends = jnp.concatenate([end[:-1], begin]), jnp.concatenate([end[1:], end])
        links, ways = jnp.split(segment_signed_distance(obstacles, starts, ends), [len(end) - 1])
        nearer = ways < signed_distance(obstacles, begin) - ROUNDING
        return jnp.minimum(links.min(), jnp.where(nearer, ways, FAR).min())
