"""Judges of reliability that learn nothing."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.geometry.sdf import segment_signed_distance, signed_distance
from doojax.models.protocols import Reliability
from doojax.modules import Jittable
from doojax.types import Obstacles, RopeState


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
    """Accepts a transition if the predicted rope touches no obstacle.

    The released code marks the voxels within ``margin`` = 2 cm of an obstacle and looks up the rope's points
    there. Here the distance is exact and taken along the straight links, so that nothing slips between two
    points; ``points_only`` looks at the points alone, as they did.
    """

    margin: float = 0.02  # m, that the rope's axis must keep from every obstacle
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
        """The least distance of the predicted rope's axis to an obstacle, metres."""
        points = next_state.points
        if self.points_only:
            return signed_distance(obstacles, points).min()
        return segment_signed_distance(obstacles, points[:-1], points[1:]).min()
