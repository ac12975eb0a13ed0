"""Training of the unconstrained dynamics as one writes it in flax: what doojax's own is measured against.

A linen module, a TrainState, and one jitted step that gives up the old state's memory. Network, frames, loss
and optimiser are those of `doojax.learning.losses.DynamicsProblem`; batches come first, as flax has them.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from flax import linen
from flax.training.train_state import TrainState
from jaxtyping import Array, Float, Int

from doojax.learning.data import Trajectories
from doojax.models.dynamics import DynamicsConfig, UnconstrainedDynamics
from doojax.models.local import flat, local_frame, unflat
from doojax.types import RopeState


class Mlp(linen.Module):
    """Fully connected, with ReLU."""

    width: int
    depth: int
    outputs: int

    @linen.compact
    def __call__(self, x: Float[Array, "batch i"]) -> Float[Array, "batch o"]:
        """The last layer has no activation."""
        for _ in range(self.depth):
            x = linen.relu(linen.Dense(self.width)(x))
        return linen.Dense(self.outputs)(x)


class Constants(eqx.Module):
    """What of an `UnconstrainedDynamics` is not trained."""

    input_mean: Float[Array, "i"]
    input_scale: Float[Array, "i"]
    output_scale: Float[Array, "o"]
    config: DynamicsConfig = eqx.field(static=True)


def peer_state(model: UnconstrainedDynamics, rate: float | optax.Schedule) -> tuple[TrainState, Constants]:
    """A copy of the model's weights, to be trained by Adam at this learning rate, and its constants."""
    config = model.config
    layers = {
        f"Dense_{i}": {"kernel": jnp.array(layer.weight.T), "bias": jnp.array(layer.bias)}
        for i, layer in enumerate(model.network.layers)
    }
    state = TrainState.create(
        apply_fn=Mlp(config.width, config.depth, config.state_size).apply,
        params=layers,
        tx=optax.adam(rate),
    )
    return state, Constants(model.input_mean, model.input_scale, model.output_scale, config)


@partial(jax.jit, donate_argnums=0)
def peer_step(
    state: TrainState, constants: Constants, data: Trajectories, rows: Int[Array, "batch"]
) -> tuple[TrainState, Float[Array, ""]]:
    """One step of Adam on the multi-step loss, and the loss before it."""
    states, actions = jax.tree.map(lambda leaf: leaf[rows], (data.states, data.actions))

    def loss(params) -> Float[Array, ""]:
        network = partial(state.apply_fn, {"params": params})
        first = jax.tree.map(lambda leaf: leaf[:, 0], states)

        def step(before: RopeState, action: Array):
            after = predict(network, constants, before, action)
            return after, after

        _, predicted = jax.lax.scan(step, first, jnp.moveaxis(actions, 1, 0))
        true = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[:, 1:], 1, 0), states)
        squares = jax.tree.map(lambda guess, truth: ((guess - truth) ** 2).sum(), predicted, true)
        count = sum(leaf.size for leaf in jax.tree.leaves(true))
        return (squares.points + squares.grippers) / count

    value, gradient = jax.value_and_grad(loss)(state.params)
    return state.apply_gradients(grads=gradient), value


def predict(
    network: Callable[[Array], Array],
    constants: Constants,
    before: RopeState,
    action: Float[Array, "batch G 3"],
) -> RopeState:
    """The next states of a batch."""
    config = constants.config
    frames = jax.vmap(partial(local_frame, origin=config.origin, symmetry=config.symmetry))(before, action)

    def inputs_of(frame, before: RopeState, action: Array) -> Float[Array, "i"]:
        local = flat(frame.points_in(before.points), frame.points_in(before.grippers))
        heading = [frame.heading(config.heading_fold)] if config.heading_fold else []
        return jnp.concatenate([local, frame.vectors_in(action).reshape(-1), *heading])

    inputs = jax.vmap(inputs_of)(frames, before, action)
    inputs = (inputs - constants.input_mean) / constants.input_scale
    change = network(inputs) * constants.output_scale
    points, grippers = jax.vmap(partial(unflat, points=config.points))(change)
    turn = jax.vmap(lambda frame, vectors: frame.vectors_out(vectors))
    return RopeState(
        points=before.points + turn(frames, points),
        grippers=before.grippers + action + turn(frames, grippers),
    )
