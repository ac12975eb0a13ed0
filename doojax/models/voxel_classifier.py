"""Where to trust the dynamics, judged from voxels: the thesis's classifier (sections 2.3.2 and 2.3.7)."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.models.calibration import CalibratedClassifier, Calibration
from doojax.models.local import flat, local_origin
from doojax.models.rasters import Encoder, ViewConfig
from doojax.types import Obstacles, RopeState, Size, Transition


@dataclass(frozen=True)
class VoxelClassifierConfig:
    """What a `VoxelClassifier` is built from."""

    points: Size  # along the rope
    view: ViewConfig
    width: Size = 128  # of the layer behind the encoder, and of the recurrent one

    @property
    def vectors(self) -> int:
        """Numbers of a step beside the encoder's features: state twice, action, uncertainty."""
        return 6 * (self.points + self.view.grippers) + 3 * self.view.grippers + 1


class VoxelClassifier(CalibratedClassifier):
    """Probability that a predicted transition's error is below the threshold that it was trained for.

    Each of the transition's two states is seen as voxels around it, in world and local coordinates, with the
    action (zero for the second) and the dynamics' uncertainty (zero for the first, as a plan's root has
    none); a recurrent layer reads the two in turn. The thesis normalises all of it over a batch; here the
    encoder's features are normalised among themselves and the other numbers divided by constants, so that an
    answer does not depend on what else is in a batch and training keeps no running averages. Its code
    declares an L2 penalty and never adds it: there is none.
    """

    encoder: Encoder
    dense: eqx.nn.Linear
    recurrent: eqx.nn.LSTMCell
    head: eqx.nn.Linear
    calibration: Calibration
    threshold: Float[Array, ""]
    config: VoxelClassifierConfig = eqx.field(static=True)

    def __init__(self, config: VoxelClassifierConfig, *, key: Array):
        encoder_key, dense_key, recurrent_key, head_key = jax.random.split(key, 4)
        self.encoder = Encoder(config.view, key=encoder_key)
        inputs = config.view.features + config.vectors
        self.dense = eqx.nn.Linear(inputs, config.width, key=dense_key)
        self.recurrent = eqx.nn.LSTMCell(config.width, config.width, key=recurrent_key)
        self.head = eqx.nn.Linear(config.width, 1, key=head_key)
        self.calibration = Calibration()
        self.threshold = jnp.array(0.5)
        self.config = config

    def logit(self, obstacles: Obstacles, transition: Transition) -> Float[Array, ""]:
        """The network's own output, before calibration."""
        state, action, uncertainty = transition.state, transition.action, transition.uncertainty
        states = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, transition.next_state)
        features = jax.vmap(self.encode, (None, 0))(obstacles, states)
        actions = jnp.stack([action, jnp.zeros_like(action)])
        uncertainties = jnp.stack([jnp.zeros_like(uncertainty), uncertainty])
        vectors = jax.vmap(self.vectors)(states, actions, uncertainties)
        steps = jax.nn.relu(jax.vmap(self.dense)(jnp.concatenate([features, vectors], axis=1)))
        memory = (jnp.zeros(self.config.width), jnp.zeros(self.config.width))
        for step in steps:
            memory = self.recurrent(step, memory)
        return self.head(memory[0])[0]

    def encode(self, obstacles: Obstacles, state: RopeState) -> Float[Array, "f"]:
        """What the voxels around a state say: the same wherever in the world it lies."""
        return self.encoder(obstacles, state)

    def vectors(
        self, state: RopeState, action: Float[Array, "G 3"], uncertainty: Float[Array, ""]
    ) -> Float[Array, "v"]:
        """A step's state in world and local coordinates, action and uncertainty, each of order one."""
        origin = local_origin(state, self.config.view.origin)
        return jnp.concatenate(
            [
                flat(state.points, state.grippers),
                flat(state.points - origin[None], state.grippers - origin[None]) / 0.2,
                action.reshape(-1) / 0.1,
                jnp.log(uncertainty + 1e-4)[None] + 3,
            ]
        )
