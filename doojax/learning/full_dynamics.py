"""Data with and without obstacles together, for dynamics that look at the obstacles."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from doojax.learning.data import Trajectories

AT_ONCE = 64  # windows of a validation split; more take too much memory


def windows(parts: Sequence[Trajectories], steps: int) -> Trajectories:
    """Pieces of ``steps`` actions of several data sets' trajectories, all in one.

    A trajectory is cut from its beginning; if something is left, its last piece overlaps the one before, so
    that every action is in one.

    Raises:
        ValueError: a part is shorter than that, or has another rope or another number of obstacles.
    """
    shapes = {
        (part.states.points.shape[2], part.states.grippers.shape[2], part.obstacles.kind.shape[1])
        for part in parts
    }
    if len(shapes) != 1:
        raise ValueError(
            f"the data have {sorted(shapes)} (points, grippers, obstacles), expected one or more data sets "
            "that agree: collect them for the same task"
        )
    shortest = min(part.actions.shape[1] for part in parts)
    if not 1 <= steps <= shortest:
        raise ValueError(
            f"steps is {steps}, expected 1 to {shortest}, the length of the shortest trajectory in the data"
        )
    pieces = []
    for part in parts:
        length = part.actions.shape[1]
        starts = np.arange(0, length - steps + 1, steps)
        if length % steps:
            starts = np.append(starts, length - steps)
        number, start = np.repeat(np.arange(len(part)), len(starts)), np.tile(starts, len(part))
        row = number[:, None]
        times = start[:, None] + np.arange(steps + 1)
        pieces.append(
            Trajectories(
                states=jax.tree.map(lambda leaf, row=row, times=times: leaf[row, times], part.states),
                actions=part.actions[row, times[:, :-1]],
                obstacles=jax.tree.map(lambda leaf, number=number: leaf[number], part.obstacles),
                rows=part.rows[number],
            )
        )
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *pieces)
