"""Fit dynamics that look at the obstacles, to data with and without obstacles together."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from doojax.learning.data import Trajectories
from doojax.learning.fit import shuffled
from doojax.learning.losses import multistep_loss
from doojax.models.full_dynamics import FullDynamics, FullDynamicsConfig

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


class FullDynamicsProblem(eqx.Module):
    """Fit `FullDynamics` to `windows` of the data that classifier and unconstrained dynamics learn from."""

    train: Trajectories
    validation: Trajectories
    config: FullDynamicsConfig = eqx.field(static=True)

    def init(self, member: PyTree, *, key: Array) -> FullDynamics:
        """A fresh network, scaled to the training data."""
        return FullDynamics(self.config, key=key).scaled_to(*self.train.transitions())

    def batches(self, member: PyTree, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Windows in random order."""
        return shuffled(len(self.train), batch_size, key=key)

    def loss(self, model: FullDynamics, rows: Int[Array, "batch"], member: PyTree) -> Float[Array, ""]:
        """The mean of `multistep_loss`."""
        return jax.vmap(errors, (None, 0))(model, jax.tree.map(lambda leaf: leaf[rows], self.train))[0].mean()

    def validate(self, model: FullDynamics, member: PyTree) -> dict[str, Float[Array, ""]]:
        """The loss, and the mean distance per point (m), over all steps of all windows."""
        loss, error = jax.lax.map(lambda window: errors(model, window), self.validation, batch_size=AT_ONCE)
        return {"loss": loss.mean(), "error_m": error.mean()}


def errors(model: FullDynamics, window: Trajectories) -> tuple[Float[Array, ""], Float[Array, "T"]]:
    """`multistep_loss` of a prediction from a window's first state, and the mean distance per point (m)."""
    first = jax.tree.map(lambda leaf: leaf[0], window.states)
    predicted = model.roll_out(window.obstacles, first, window.actions)
    distance = jnp.linalg.norm((predicted.points - window.states.points)[1:], axis=-1)
    return multistep_loss(predicted, window.states), distance.mean(-1)
