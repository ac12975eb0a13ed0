"""Straight lines between joint positions, checked a few places at a time: many at once, each at its own pace.

Whoever goes along lines has one (`Walk.line`). In each round the next few places of every line are asked
whether they are free, all of them in one call, and those whose line ended begin another. So nobody waits for
the end of a long line, and what is not free is left at once.
"""

from collections.abc import Callable
from functools import lru_cache
from math import gcd
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

MOST_PLACES = 512  # on a line
ROUNDS = 8  # until lanes whose walk ended are given to others

type FreeMany = Callable[[Float[Array, "N M"], Int[Array, "N"], Float[Array, "N *s"]], Bool[Array, "N"]]
"""Whether N joint positions, of the queries with these numbers, keep these margins (m; what it takes)."""


class Line(eqx.Module):
    """From one joint position to another; the first is known to be free."""

    begin: Float[Array, "*b M"]
    end: Float[Array, "*b M"]
    count: Int[Array, "*b"]  # of places, the end included
    asked: Int[Array, "*b"]  # how many of them were

    def places(self, number: int) -> tuple[Float[Array, "n M"], Bool[Array, "n"]]:
        """The next so many places of one line, and which of them there are.

        First its end, then in steps of about 0.618 of the line, modulo its length: those far from all before.
        """
        index = self.asked + jnp.arange(number)
        place = (index * jnp.asarray(_strides())[self.count]) % self.count
        along = (place / self.count)[:, None]
        joints = jnp.where(place[:, None] == 0, self.end, self.begin + along * (self.end - self.begin))
        return joints, index < self.count

    def over(self, number: int) -> Bool[Array, "*b"]:
        """Whether nothing is left after so many more places."""
        return self.asked + number >= self.count


def line_to(begin: Float[Array, "M"], end: Float[Array, "M"], step: float | Float[Array, ""]) -> Line:
    """Places at most ``step`` apart by the joint that moves most, but never more than `MOST_PLACES`."""
    longest = jnp.max(jnp.abs(end - begin))
    count = jnp.clip(jnp.ceil(longest / step), 1, MOST_PLACES).astype(int)
    return Line(begin, end, count, jnp.zeros((), int))


@runtime_checkable
class Places(Protocol):
    """What is asked about, a few places at a time: a `Line`, or what else has a beginning and an end."""

    begin: Float[Array, "*b M"]

    def places(self, number: int) -> tuple[Float[Array, "n M"], Bool[Array, "n"]]:
        """See `Line.places`."""
        ...

    def over(self, number: int) -> Bool[Array, "*b"]:
        """See `Line.over`."""
        ...


@runtime_checkable
class Walk(Protocol):
    """Whoever goes along lines: arrays, of one query or of many."""

    @property
    def line(self) -> Places:
        """That it is on."""
        ...

    @property
    def going(self) -> Bool[Array, "*b"]:
        """Whether it goes on."""
        ...

    @property
    def margin(self) -> Float[Array, "..."]:
        """What the line's places must keep, m: of shape *b, or one for each part of the robot, last."""
        ...


class Outcome(eqx.Module):
    """What came of the places of one line that were asked."""

    asked: Int[Array, "*b"]
    before: Int[Array, "*b"]  # of them, before the first that is not free
    failed: Bool[Array, "*b"]  # one is not free
    passed: Bool[Array, "*b"]  # all of the line are


def walked[W: Walk](
    walks: W,
    free: FreeMany,
    go_on: Callable[[W, Outcome, Int[Array, ""]], W],
    lanes: int,
    at_once: int,
    least: int = 0,
) -> W:
    """Q walks, until at most ``least`` go on; ``lanes`` go at once, ``at_once`` places a round, others wait.

    ``go_on(walk, outcome, number)`` is one walk after a round; it is called for one that ended too, and must
    then leave it as it is.
    """
    total = walks.line.begin.shape[0]
    width = min(lanes, total)

    def a_round(_: Array, now: tuple[W, Array]) -> tuple[W, Array]:
        own, numbers = now
        places, real = jax.vmap(lambda line: line.places(at_once))(own.line)
        flat = places.reshape(width * at_once, -1)
        query, margin = (jnp.repeat(values, at_once, axis=0) for values in (numbers, own.margin))
        passed = free(flat, query, margin).reshape(width, at_once) | ~real
        failed = ~passed.all(1)
        before = jnp.cumprod(passed, axis=1, dtype=int).sum(1)
        over = jax.vmap(lambda line: line.over(at_once))(own.line)
        outcome = Outcome(real.sum(1), before, failed, ~failed & over)
        return jax.vmap(go_on)(own, outcome, numbers), numbers

    def advance(walks: W) -> W:
        lane = jnp.nonzero(walks.going, size=width, fill_value=total)[0]
        own = jax.tree.map(lambda leaf: leaf.at[lane].get(mode="clip"), walks)
        after, _ = jax.lax.fori_loop(0, ROUNDS, a_round, (own, jnp.minimum(lane, total - 1)))
        return jax.tree.map(lambda all_, some: all_.at[lane].set(some, mode="drop"), walks, after)

    return jax.lax.while_loop(lambda walks: walks.going.sum() > least, advance, walks)


@lru_cache(maxsize=1)
def _strides() -> np.ndarray:
    """For each number of places the step through them that is nearest to 0.618 of it and meets all."""
    found = np.ones(MOST_PLACES + 1, np.int32)
    for count in range(2, MOST_PLACES + 1):
        coprime = (step for step in range(1, count) if gcd(step, count) == 1)
        found[count] = min(coprime, key=lambda step, count=count: abs(step - 0.618 * count))
    return found
