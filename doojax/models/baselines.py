"""Judges of reliability that learn nothing, and what can be made of judges."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.geometry.sdf import signed_distance
from doojax.geometry.segment_sdf import segment_signed_distance
from doojax.geometry.shapes import FAR
from doojax.models.local import chain_of
from doojax.models.protocols import Reliability, above
from doojax.modules import Jittable
from doojax.types import Judgement, Obstacles, RopeState, Transition

ROUNDING = 1e-5  # m


class Always(Jittable):
    """Accepts every transition: planning without a classifier."""

    def __call__(self, obstacles: Obstacles, transition: Transition) -> Judgement:
        """One, whatever is predicted."""
        return above(jnp.ones(()), 0.0)


class Stricter(Jittable):
    """Another judge's scores with a threshold of one's own."""

    judge: Reliability
    threshold: float

    def __call__(self, obstacles: Obstacles, transition: Transition) -> Judgement:
        """The other judge's score, accepted above the threshold."""
        found = self.judge(obstacles, transition)
        return Judgement(found.score, found.score > self.threshold, found.possible)


class Conjunction(Jittable):
    """Accepts what all of some judges accept, and holds possible what all hold possible.

    The score is that of the first: give the one first by whose scores searches are to be understood.
    """

    judges: tuple[Reliability, ...]

    def __check_init__(self):
        """Refuse none."""
        if not self.judges:
            raise ValueError("a conjunction needs at least one judge; use Always to accept everything")

    def __call__(self, obstacles: Obstacles, transition: Transition) -> Judgement:
        """The first one's score, and what all agree on."""
        found = [judge(obstacles, transition) for judge in self.judges]
        accepted, possible = found[0].accepted, found[0].possible
        for one in found[1:]:
            accepted, possible = accepted & one.accepted, possible & one.possible
        return Judgement(found[0].score, accepted, possible)


class CollisionChecker(Jittable):
    """Accepts a transition if rope and grippers, or whatever bodies there are, touch no obstacle on the way.

    The released code marks the voxels within ``margin`` = 2 cm of an obstacle and looks up the rope's points
    there, after the motion. Here the distance is exact and taken along the straight links, so that nothing
    slips between two points, and along the straight ways of all points and grippers, so that nothing cuts a
    corner whose two ends are clear; ``points_only`` looks at the rope's points alone, as they did. A way
    counts where it comes nearer to an obstacle than where it begins, so that a rope that touches one already
    may leave it.
    """

    margin: Float[Array, ""] | float = (
        0.02  # m, that the rope's axis and the grippers must keep from every obstacle
    )
    points_only: bool = eqx.field(static=True, default=False)

    def __call__(self, obstacles: Obstacles, transition: Transition) -> Judgement:
        """The least distance to an obstacle, metres; nearer than the margin is impossible."""
        distance = self.distance(obstacles, transition)
        clear = distance > self.margin
        return Judgement(distance, clear, clear)

    def distance(self, obstacles: Obstacles, transition: Transition) -> Float[Array, ""]:
        """The least distance to an obstacle of the rope's axis and the grippers, or of all bodies, metres."""
        before, after = transition.state, transition.next_state
        if self.points_only:
            return signed_distance(obstacles, after.bodies()[: after.passive]).min()
        if isinstance(before, RopeState) and isinstance(after, RopeState):
            begin, end = chain_of(before, midpoints=False), chain_of(after, midpoints=False)
            starts, ends = jnp.concatenate([end[:-1], begin]), jnp.concatenate([end[1:], end])
            there, ways = jnp.split(segment_signed_distance(obstacles, starts, ends), [len(end) - 1])
        else:  # bodies that nothing joins
            begin, end = before.bodies(), after.bodies()
            there, ways = signed_distance(obstacles, end), segment_signed_distance(obstacles, begin, end)
        nearer = ways < signed_distance(obstacles, begin) - ROUNDING
        return jnp.minimum(there.min(), jnp.where(nearer, ways, FAR).min())
