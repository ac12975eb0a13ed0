"""What each network learns, as `doojax.learning.fit.Problem`s."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from doojax.learning.buffer import Buffer
from doojax.learning.data import Trajectories
from doojax.learning.fit import shuffled
from doojax.models.builders import dynamics_network
from doojax.models.protocols import Dynamics
from doojax.models.rolling import roll_out


def multistep_loss(predicted: Any, true: Any) -> Float[Array, ""]:
    """Squared error of T + 1 states, the first of which is given: equation 2.5.

    The mean over steps 1 to T of the squared norm of all coordinates, divided by their number d (a constant
    that makes losses of different ropes comparable), m^2. The released code gives the rope's mean and the
    grippers' mean equal weight instead; grippers go where they are sent, so little hangs on it.
    """
    return _squares(predicted, true).mean()


def loss_by_step(predicted: Any, true: Any) -> Float[Array, "T"]:
    """What of `multistep_loss` each of the steps 1 to T contributes, times T; m^2."""
    return _squares(predicted, true).mean(1)


def _squares(predicted: Any, true: Any) -> Float[Array, "T d"]:
    errors = jax.tree.map(lambda guess, truth: (guess - truth)[1:], predicted, true)
    squares = [(leaf**2).reshape(leaf.shape[0], -1) for leaf in jax.tree.leaves(errors)]
    return jnp.concatenate(squares, axis=1)


class DynamicsProblem(eqx.Module):
    """Fit any dynamics to whole trajectories, or to pieces of them."""

    train: Trajectories | Buffer  # a buffer holds trajectories
    validation: Trajectories
    config: Any = eqx.field(static=True)  # of the network
    normalise: bool = eqx.field(static=True)  # does `init` scale inputs and outputs by the training data?
    network: Any = eqx.field(static=True, default=dynamics_network)  # makes one of config and key
    steps: int = eqx.field(static=True, default=0)  # of an epoch; 0: as many as the data make; for a buffer
    at_once: int = eqx.field(static=True, default=4096)  # validated trajectories; more may take much memory

    @property
    def trajectories(self) -> Trajectories:
        """The training data."""
        return self.train.items if isinstance(self.train, Buffer) else self.train

    def init(self, member: PyTree, *, key: Array) -> Any:
        """A fresh network, scaled to the training data if asked for."""
        model = self.network(self.config, key=key)
        return model.scaled_to(*self.trajectories.transitions()) if self.normalise else model

    def batches(self, member: PyTree, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Trajectories in random order; of a buffer, by their weights."""
        if isinstance(self.train, Buffer):
            return self.train.drawn(self.steps or self.train.capacity // batch_size, batch_size, key=key)
        return shuffled(len(self.train), batch_size, key=key)

    def loss(self, model: Any, rows: Int[Array, "batch"], member: PyTree) -> Float[Array, ""]:
        """The mean of `multistep_loss`."""
        batch = jax.tree.map(lambda leaf: leaf[rows], self.trajectories)
        return jax.vmap(errors, (None, 0))(model, batch)[0].mean()

    def validate(self, model: Any, member: PyTree) -> dict[str, Float[Array, ""]]:
        """The loss, and the mean distance per passive body (m), over steps 1 to T of all trajectories."""
        loss, error = jax.lax.map(
            lambda one: errors(model, one),
            self.validation,
            batch_size=min(self.at_once, len(self.validation)),
        )
        return {"loss": loss.mean(), "error_m": error.mean()}


def errors(model: Dynamics, one: Trajectories) -> tuple[Float[Array, ""], Float[Array, "T"]]:
    """Of one trajectory, predicted from its first state: `multistep_loss`, and mean distances by step.

    Distances (m) are those of the passive bodies, such as a rope's points.
    """
    first = jax.tree.map(lambda leaf: leaf[0], one.states)
    predicted, _ = roll_out(model, one.obstacles, first, one.actions)
    gaps = (predicted.bodies() - one.states.bodies())[1:, : first.passive]
    return multistep_loss(predicted, one.states), jnp.linalg.norm(gaps, axis=-1).mean(-1)
