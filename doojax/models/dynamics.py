"""Dynamics of a rope that nothing gets in the way of: a residual network in a local frame."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from doojax.models.local import LocalFrame, Origin, Symmetry, flat, local_frame, unflat
from doojax.modules import Jittable
from doojax.types import Depth, Obstacles, RopeState, Size

SMALLEST_SCALE = 0.03  # m: what varies less is not blown up, lest small errors look large a step later


@dataclass(frozen=True)
class DynamicsConfig:
    """What an `UnconstrainedDynamics` is built from."""

    points: Size  # along the rope
    grippers: Size
    origin: Origin
    width: Size = 1024
    depth: Depth = 2  # hidden layers
    symmetry: Symmetry = "translation"
    heading_fold: int = 0
    """In a canonical frame, motion is the same after turns of the world by 2 pi / this many; 0: by any.

    Friction along a few lines, as the planar rope's, is not the same in all directions."""

    def __post_init__(self):
        """Refuse a heading where there is none."""
        if self.heading_fold < 0 or (self.heading_fold and self.symmetry != "canonical"):
            raise ValueError(
                f"heading_fold is {self.heading_fold} with symmetry {self.symmetry!r}: expected 0, or a "
                "positive number with symmetry 'canonical'"
            )

    @property
    def input_size(self) -> int:
        """Numbers that the network sees."""
        return self.state_size + 3 * self.grippers + (2 if self.heading_fold else 0)

    @property
    def state_size(self) -> int:
        """Coordinates of a state."""
        return 3 * (self.points + self.grippers)


class UnconstrainedDynamics(Jittable):
    """Next state = state + change(state, action), all in a local frame; obstacles are not looked at.

    Thesis section 2.3.7.1: a fully connected network with ReLU. Beyond it, the grippers' change is counted
    from where they are sent, and `scaled_to` shifts and scales what goes in and out to unit variance; those
    scales are constants that no gradient reaches.
    """

    network: eqx.nn.MLP
    input_mean: Float[Array, "i"]
    input_scale: Float[Array, "i"]
    output_scale: Float[Array, "o"]
    config: DynamicsConfig = eqx.field(static=True)

    def __init__(self, config: DynamicsConfig, *, key: Array):
        inputs, outputs = config.input_size, config.state_size
        self.network = eqx.nn.MLP(inputs, outputs, config.width, config.depth, key=key)
        self.input_mean = jnp.zeros(inputs)
        self.input_scale = jnp.ones(inputs)
        self.output_scale = jnp.ones(outputs)
        self.config = config

    def predict(self, state: RopeState, action: Float[Array, "G 3"]) -> RopeState:
        """The next state after gripper displacements (m)."""
        frame, inputs = self._inputs(state, action)
        inputs = (inputs - stop_gradient(self.input_mean)) / stop_gradient(self.input_scale)
        change = self.network(inputs) * stop_gradient(self.output_scale)
        points, grippers = unflat(change, self.config.points)
        return RopeState(
            points=state.points + frame.vectors_out(points),
            grippers=state.grippers + action + frame.vectors_out(grippers),
        )

    def __call__(
        self, obstacles: Obstacles | None, state: RopeState, action: Float[Array, "G 3"]
    ) -> tuple[RopeState, Float[Array, ""]]:
        """See `doojax.models.protocols.Dynamics`; one network alone has no doubts: 0."""
        return self.predict(state, action), jnp.zeros(())

    def scaled_to(
        self, states: RopeState, actions: Float[Array, "n G 3"], after: RopeState
    ) -> "UnconstrainedDynamics":
        """The same network, for inputs and outputs shifted and scaled by those of n transitions."""

        def in_and_out(state: RopeState, action: Array, after: RopeState) -> tuple[Array, Array]:
            frame, inputs = self._inputs(state, action)
            points = frame.vectors_in(after.points - state.points)
            return inputs, flat(points, frame.vectors_in(after.grippers - state.grippers - action))

        inputs, outputs = jax.vmap(in_and_out)(states, actions, after)
        return with_scales(self, inputs, outputs)

    def _inputs(self, state: RopeState, action: Float[Array, "G 3"]) -> tuple[LocalFrame, Float[Array, "i"]]:
        frame = local_frame(state, action, self.config.origin, self.config.symmetry)
        local = flat(frame.points_in(state.points), frame.points_in(state.grippers))
        heading = frame.heading(self.config.heading_fold) if self.config.heading_fold else jnp.zeros(0)
        return frame, jnp.concatenate([local, frame.vectors_in(action).reshape(-1), heading])


def with_scales[M: eqx.Module](model: M, inputs: Float[Array, "n i"], outputs: Float[Array, "n o"]) -> M:
    """A model whose inputs are shifted and scaled, and its outputs scaled, by those of n transitions."""
    return eqx.tree_at(
        lambda model: (model.input_mean, model.input_scale, model.output_scale),
        model,
        (
            inputs.mean(0),
            jnp.maximum(inputs.std(0), SMALLEST_SCALE),
            jnp.maximum(outputs.std(0), SMALLEST_SCALE),
        ),
    )
