"""Dynamics that look at the obstacles: the baseline that needs no classifier (thesis section 2.4.3).

What the released code does with pictures of a planar scene, here with the classifier's voxels.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from doojax.models.dynamics import with_scales
from doojax.models.local import flat, local_origin, unflat
from doojax.models.rasters import Encoder, ViewConfig
from doojax.modules import Jittable
from doojax.types import Obstacles, RopeState, Size


@dataclass(frozen=True)
class FullDynamicsConfig:
    """What a `FullDynamics` is built from."""

    points: Size  # along the rope
    view: ViewConfig
    width: Size = 200  # of the layers that see state and action
    scene_width: Size = 32  # of those that see the scene
    scene_size: Size = 5  # numbers that the scene is condensed to

    @property
    def state_size(self) -> int:
        """Coordinates of a state."""
        return 3 * (self.points + self.view.grippers)


class FullDynamics(Jittable):
    """Next state = state + change(obstacles, state, action), in a local frame with the world's axes.

    A few numbers that say what the scene is like multiply, each with each, what a layer makes of state and
    action; two layers turn the products into the change. The voxels are drawn anew around every predicted
    state. As in `doojax.models.dynamics.UnconstrainedDynamics`, the grippers' change is counted from where
    they are sent, and `scaled_to` sets constants that bring inputs and outputs to unit variance.
    """

    encoder: Encoder
    scene: eqx.nn.MLP
    motion: eqx.nn.Linear
    change: eqx.nn.MLP
    input_mean: Float[Array, "i"]
    input_scale: Float[Array, "i"]
    output_scale: Float[Array, "o"]
    config: FullDynamicsConfig = eqx.field(static=True)

    def __init__(self, config: FullDynamicsConfig, *, key: Array):
        encoder_key, scene_key, motion_key, change_key = jax.random.split(key, 4)
        inputs, outputs = config.state_size + 3 * config.view.grippers, config.state_size
        scene, width = config.scene_size, config.width
        self.encoder = Encoder(config.view, key=encoder_key)
        self.scene = eqx.nn.MLP(config.view.features, scene, config.scene_width, 2, key=scene_key)
        self.motion = eqx.nn.Linear(inputs, width, key=motion_key)
        self.change = eqx.nn.MLP(width * scene, outputs, width, 2, key=change_key)
        self.input_mean = jnp.zeros(inputs)
        self.input_scale = jnp.ones(inputs)
        self.output_scale = jnp.ones(outputs)
        self.config = config

    def predict(self, obstacles: Obstacles, state: RopeState, action: Float[Array, "G 3"]) -> RopeState:
        """The next state after gripper displacements (m)."""
        inputs = self._inputs(state, action)
        inputs = (inputs - stop_gradient(self.input_mean)) / stop_gradient(self.input_scale)
        motion = jax.nn.relu(self.motion(inputs))
        scene = self.scene(self.encoder(obstacles, state))
        change = self.change(jnp.outer(motion, scene).reshape(-1)) * stop_gradient(self.output_scale)
        points, grippers = unflat(change, self.config.points)
        return RopeState(points=state.points + points, grippers=state.grippers + action + grippers)

    def __call__(
        self, obstacles: Obstacles, state: RopeState, action: Float[Array, "G 3"]
    ) -> tuple[RopeState, Float[Array, ""]]:
        """See `doojax.models.protocols.Dynamics`; one network alone has no doubts: 0."""
        return self.predict(obstacles, state, action), jnp.zeros(())

    def scaled_to(
        self, states: RopeState, actions: Float[Array, "n G 3"], after: RopeState
    ) -> "FullDynamics":
        """The same network, for inputs and outputs shifted and scaled by those of n transitions."""

        def in_and_out(state: RopeState, action: Array, after: RopeState) -> tuple[Array, Array]:
            moved = flat(after.points - state.points, after.grippers - state.grippers - action)
            return self._inputs(state, action), moved

        inputs, outputs = jax.vmap(in_and_out)(states, actions, after)
        return with_scales(self, inputs, outputs)

    def _inputs(self, state: RopeState, action: Float[Array, "G 3"]) -> Float[Array, "i"]:
        origin = local_origin(state, self.config.view.origin)
        local = flat(state.points - origin[None], state.grippers - origin[None])
        return jnp.concatenate([local, action.reshape(-1)])
