"""Whether a motion is free everywhere, and not at some places of it alone.

No part of a robot moves farther than its `doojax.robots.travel` while joints go straight. So a stretch of a
line is free if its middle is, with each part as much larger as it travels in half of the stretch. Stretches
grow where there is room and halve where there is not.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from doojax.planning.joint_lines import Outcome

FIRST = 0.1  # m, that no part travels farther on the first stretches of a line
LEAST = 1e-3  # m, that some part travels on one: where no more is free, the line counts as not free
DONE = 1 - 1e-6


class Stretches(eqx.Module):
    """Of a line from one joint position to another."""

    begin: Float[Array, "*b M"]
    end: Float[Array, "*b M"]
    travel: Float[Array, "*b S"]  # m, of each part of the robot
    at: Float[Array, "*b"]  # the share of the line that is free for certain
    part: Float[Array, "*b"]  # the share of a stretch

    def places(self, number: int) -> tuple[Float[Array, "n M"], Bool[Array, "n"]]:
        """The middles of the next stretches of one line."""
        begins = self.at + jnp.arange(number) * self.part
        middles = jnp.minimum(begins + self.part / 2, 1)
        return self.begin + middles[:, None] * (self.end - self.begin), begins < DONE

    def over(self, number: int) -> Bool[Array, "*b"]:
        """Whether nothing is left after so many more stretches."""
        return self.at + number * self.part >= DONE


class Sweep(eqx.Module):
    """A way whose lines are checked one after another."""

    points: Float[Array, "*b W M"]
    count: Int[Array, "*b"]  # of points; after the last they repeat it
    travels: Float[Array, "*b W-1 S"]  # m, along each line
    first: Int[Array, "*b"]  # where the line begins
    line: Stretches
    free: Bool[Array, "*b"]  # nothing so far is in the way
    ended: Bool[Array, "*b"]

    @property
    def going(self) -> Bool[Array, "*b"]:
        """Whether there is more to check."""
        return ~self.ended

    @property
    def margin(self) -> Float[Array, "*b S"]:
        """How far parts are from where a stretch's middle has them, at most, m."""
        return self.line.travel * self.line.part[..., None] / 2


def sweep(
    points: Float[Array, "W M"], count: Int[Array, ""], travels: Float[Array, "W-1 S"], whole: Bool[Array, ""]
) -> Sweep:
    """Of one way, at its start."""
    zero = jnp.zeros((), int)
    bounded = whole & jnp.isfinite(travels).all()
    return Sweep(points, count, travels, zero, _stretches(points, travels, zero), bounded, ~bounded)


def swept(own: Sweep, outcome: Outcome, at_once: int) -> Sweep:
    """One way after ``at_once`` stretches of its line were asked."""
    line, all_free = own.line, ~outcome.failed
    at = line.at + outcome.before * line.part
    part = jnp.where(all_free, 2 * line.part, line.part / 2)
    stopped = ~all_free & (line.travel.max() * part < LEAST)
    first = own.first + 1
    over = outcome.passed & (first >= own.count - 1)
    begun = _stretches(own.points, own.travels, jnp.minimum(first, len(own.points) - 2))
    left = eqx.tree_at(lambda one: (one.at, one.part), line, (at, part))
    after = (
        jnp.where(outcome.passed & ~over, first, own.first),
        jax.tree.map(lambda new, old: jnp.where(outcome.passed, new, old), begun, left),
        own.free & ~stopped,
        over | stopped,
    )
    before = own.first, own.line, own.free, own.ended
    return eqx.tree_at(
        lambda s: (s.first, s.line, s.free, s.ended),
        own,
        jax.tree.map(lambda new, old: jnp.where(own.ended, old, new), after, before),
    )


def _stretches(
    points: Float[Array, "W M"], travels: Float[Array, "W-1 S"], first: Int[Array, ""]
) -> Stretches:
    travel = travels[first]
    part = jnp.minimum(0.25, FIRST / jnp.maximum(travel.max(), FIRST))
    return Stretches(points[first], points[first + 1], travel, jnp.zeros_like(part), part)
