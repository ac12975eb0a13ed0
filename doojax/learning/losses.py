"""What each network learns, as `doojax.learning.fit.Problem`s."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from doojax.learning.data import Trajectories
from doojax.learning.fit import shuffled
from doojax.models.dynamics import DynamicsConfig, UnconstrainedDynamics
from doojax.models.ensemble import roll_out
from doojax.types import RopeState


def multistep_loss(predicted: RopeState, true: RopeState) -> Float[Array, ""]:
    """Squared error of T + 1 states, the first of which is given: equation 2.5.

    The mean over steps 1 to T of the squared norm of all coordinates, divided by their number d (a constant
    that makes losses of different ropes comparable), m^2. The released code gives the rope's mean and the
    grippers' mean equal weight instead; grippers go where they are sent, so little hangs on it.
    """
    errors = jax.tree.map(lambda guess, truth: (guess - truth)[1:], predicted, true)
    squares = [(leaf**2).reshape(leaf.shape[0], -1) for leaf in jax.tree.leaves(errors)]
    return jnp.concatenate(squares, axis=1).mean()


class DynamicsProblem(eqx.Module):
    """Fit `UnconstrainedDynamics` to whole trajectories."""

    train: Trajectories
    validation: Trajectories
    config: DynamicsConfig = eqx.field(static=True)
    normalise: bool = eqx.field(static=True)

    def init(self, member: PyTree, *, key: Array) -> UnconstrainedDynamics:
        """A fresh network, scaled to the training data if asked for."""
        model = UnconstrainedDynamics(self.config, key=key)
        if not self.normalise:
            return model
        return model.scaled_to(*self.train.transitions())

    def batches(self, member: PyTree, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Trajectories in random order."""
        return shuffled(len(self.train), batch_size, key=key)

    def loss(
        self, model: UnconstrainedDynamics, rows: Int[Array, "batch"], member: PyTree
    ) -> Float[Array, ""]:
        """The mean of `multistep_loss`."""
        states, actions = jax.tree.map(lambda leaf: leaf[rows], (self.train.states, self.train.actions))
        return jax.vmap(trajectory_loss, (None, 0, 0))(model, states, actions).mean()

    def validate(self, model: UnconstrainedDynamics, member: PyTree) -> dict[str, Float[Array, ""]]:
        """The loss, and the mean distance per point (m), over steps 1 to T of whole trajectories."""
        states, actions = self.validation.states, self.validation.actions
        first = jax.tree.map(lambda leaf: leaf[:, 0], states)
        predicted = jax.vmap(roll_out, (None, 0, 0))(model, first, actions)
        error = jnp.linalg.norm((predicted.points - states.points)[:, 1:], axis=-1)
        return {"loss": jax.vmap(multistep_loss)(predicted, states).mean(), "error_m": error.mean()}


def trajectory_loss(
    model: UnconstrainedDynamics, states: RopeState, actions: Float[Array, "T G 3"]
) -> Float[Array, ""]:
    """`multistep_loss` of a prediction from a trajectory's first state."""
    first = jax.tree.map(lambda leaf: leaf[0], states)
    return multistep_loss(roll_out(model, first, actions), states)
