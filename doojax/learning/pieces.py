"""Trajectories of any lengths cut into pieces of one length, predicted from their true first states."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from doojax.learning.data import Trajectories
from doojax.learning.labels import rms_distance
from doojax.models.protocols import Dynamics
from doojax.models.rolling import roll_out

AT_ONCE = 256  # pieces predicted in one call, so that another number of them compiles nothing anew


class Pieces(eqx.Module):
    """n pieces of H actions; what is missing at the end of a trajectory repeats its last state."""

    trajectories: Trajectories  # [n]
    there: Bool[Array, "n H"]  # false for steps that are missing
    origin: Int[Array, "n"]  # the trajectory that each is from, numbered through all of them

    def __len__(self) -> int:
        """n."""
        return self.origin.shape[0]

    @property
    def steps(self) -> int:
        """H."""
        return self.there.shape[1]

    @property
    def transitions(self) -> int:
        """How many steps are there."""
        return int(np.asarray(self.there).sum())


def cut(data: Trajectories | Sequence[Trajectories], steps: int, *, every: int | None = None) -> Pieces:
    """Cut trajectories, such as executed plans of different lengths, into pieces.

    Args:
        data: one or more batches; lengths may differ from batch to batch.
        steps: H, actions of a piece.
        every: how far apart pieces begin; by default H, so that each transition is in one piece. With 1,
            pieces begin at every state that something was done in.

    Raises:
        ValueError: for no trajectories, batches of different shapes (of state, action or obstacles), values
            that are not finite, or counts below 1.
    """
    parts = [data] if isinstance(data, Trajectories) else list(data)
    stride = steps if every is None else every
    for name, count in (("steps", steps), ("every", stride)):
        if count < 1:
            raise ValueError(f"{name} is {count}, expected at least 1")
    parts = [part for part in parts if len(part) and part.actions.shape[1]]
    if not parts:
        raise ValueError("there are no trajectories to cut: collect some first")
    _require_alike(parts)
    found, before = [], 0
    for part in parts:
        found.append(_cut_one(part, steps, stride, before))
        before += len(part)
    states, actions, obstacles, rows, there, origin = jax.tree.map(
        lambda *leaves: jnp.asarray(np.concatenate(leaves)), *found
    )
    pieces = Pieces(Trajectories(states, actions, obstacles, rows), there, origin)
    _require_finite(pieces)
    return pieces


def _cut_one(part: Trajectories, steps: int, stride: int, before: int) -> tuple[Any, ...]:
    """States, actions, obstacles, rows, there and origin of the pieces of one batch, in numpy."""
    length = part.actions.shape[1]
    starts = np.arange(0, length, stride)
    number, start = np.repeat(np.arange(len(part)), len(starts)), np.tile(starts, len(part))
    row, times = number[:, None], start[:, None] + np.arange(steps + 1)
    held = jax.tree.map(np.asarray, part)
    return (
        jax.tree.map(lambda leaf: leaf[row, np.minimum(times, length)], held.states),
        held.actions[row, np.minimum(times[:, :-1], length - 1)],
        jax.tree.map(lambda leaf: leaf[number], held.obstacles),
        held.rows[number],
        times[:, :-1] < length,
        (before + number).astype(np.int32),
    )


def _require_alike(parts: Sequence[Trajectories]) -> None:
    def shapes(part: Trajectories) -> list[tuple[int, ...]]:
        own = [leaf.shape[2:] for leaf in (*jax.tree.leaves(part.states), part.actions)]
        return own + [leaf.shape[1:] for leaf in jax.tree.leaves(part.obstacles)]

    for part in parts[1:]:
        if shapes(part) != shapes(parts[0]):
            raise ValueError(
                f"trajectories have states, actions and obstacles of shapes {shapes(part)} and "
                f"{shapes(parts[0])}, expected equal ones: collect them for the same task, of ropes with as "
                "many points"
            )


def _require_finite(pieces: Pieces) -> None:
    leaves = jax.tree.leaves((pieces.trajectories.states, pieces.trajectories.actions))
    sound = [np.isfinite(np.asarray(leaf)).reshape(len(leaf), -1).all(1) for leaf in leaves]
    bad = ~np.all(sound, axis=0)
    if bad.any():
        worst = ", ".join(str(number) for number in np.unique(np.asarray(pieces.origin)[bad])[:8])
        raise ValueError(
            f"{bad.sum()} of {len(bad)} pieces, of trajectories such as {worst}, have values that are not "
            "finite: leave out trajectories with faults"
        )


def piece_errors(dynamics: Dynamics, one: Trajectories) -> Float[Array, "H"]:
    """`rms_distance` (m) after each step of one piece, predicted from its true first state."""
    first = jax.tree.map(lambda leaf: leaf[0], one.states)
    return rms_distance(roll_out(dynamics, one.obstacles, first, one.actions)[0], one.states)[1:]


def step_errors(dynamics: Dynamics, pieces: Pieces) -> Float[np.ndarray, "n H"]:
    """`piece_errors` of all pieces, m; NaN for steps that are missing."""
    found = chunked(_errors_of_many, dynamics, pieces.trajectories)
    return np.where(np.asarray(pieces.there), found, np.nan)


@eqx.filter_jit
def _errors_of_many(dynamics: Dynamics, data: Trajectories) -> Float[Array, "n H"]:
    return jax.vmap(piece_errors, (None, 0))(dynamics, data)


def chunked(function: Any, fixed: Any, batch: Any) -> Any:
    """``function(fixed, chunk)`` of chunks of `AT_ONCE` elements, the last filled up; in numpy, joined."""
    held = jax.tree.map(np.asarray, batch)
    count = len(jax.tree.leaves(held)[0])
    found = []
    for first in range(0, count, AT_ONCE):
        rows = np.minimum(np.arange(first, first + AT_ONCE), count - 1)
        found.append(jax.tree.map(np.asarray, function(fixed, jax.tree.map(lambda x, r=rows: x[r], held))))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *found)
