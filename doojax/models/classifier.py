"""Where the dynamics can be trusted, judged from distances: no voxels.

The classifier looks at the rope as a chain of points that moves from a state to the predicted next one. At a
few moments of that motion it takes the signed distance to the obstacles, and its gradient, at every point of
the chain; a small convolutional network along the chain turns that into one number. Nothing is rasterised, so
a thin obstacle is as visible as a thick one, and a transition costs about a thousandth of a voxel grid's.
"""

from dataclasses import dataclass
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.geometry.sdf import signed_distance_and_gradient
from doojax.models.calibration import CalibratedClassifier, Calibration
from doojax.models.local import Origin, chain_of, local_frame
from doojax.modules import Jittable
from doojax.types import Depth, Obstacles, Size, Transition

NEAR, FAR = 0.02, 0.1  # m: the two scales on which distances are seen


@dataclass(frozen=True)
class ClassifierConfig:
    """What a `DistanceClassifier` is built from."""

    grippers: Size
    origin: Origin
    width: Size = 64
    layers: Depth = 2  # convolutions along the chain
    moments: Depth = 3  # of the motion, first and last included
    midpoints: bool = True  # between neighbours of the chain, too

    @property
    def features(self) -> int:
        """Numbers per point of the chain."""
        return 7 + 5 * self.moments

    @property
    def globals(self) -> int:
        """Numbers that concern the transition as a whole."""
        return 3 * self.grippers + 1


class ChainConvolution(Jittable):
    """A residual convolution over three neighbours, written as a matrix product, which CPUs are good at.

    Products are shifted, not what goes into them: a third as much to copy.
    """

    linear: eqx.nn.Linear

    def __init__(self, width: int, *, key: Array):
        self.linear = eqx.nn.Linear(3 * width, width, key=key)

    def __call__(self, x: Float[Array, "L w"]) -> Float[Array, "L w"]:
        """The ends see zeros beyond them."""
        width = x.shape[1]
        before, here, after = jnp.split(self.linear.weight, 3, axis=1)
        parts = x @ jnp.concatenate([before, here, after]).T
        from_before = jnp.pad(parts[:-1, :width], ((1, 0), (0, 0)))
        from_after = jnp.pad(parts[1:, 2 * width :], ((0, 1), (0, 0)))
        total = from_before + parts[:, width : 2 * width] + from_after + cast(Array, self.linear.bias)[None]
        return x + jax.nn.relu(total)


class DistanceClassifier(CalibratedClassifier):
    """Probability that a predicted transition's error is below the threshold that it was trained for."""

    embed: eqx.nn.Linear
    convolutions: list[ChainConvolution]
    head: eqx.nn.MLP
    calibration: Calibration
    threshold: Float[Array, ""]
    config: ClassifierConfig = eqx.field(static=True)

    def __init__(self, config: ClassifierConfig, *, key: Array):
        embed_key, head_key, *keys = jax.random.split(key, 2 + config.layers)
        width = config.width
        self.embed = eqx.nn.Linear(config.features, width, key=embed_key)
        self.convolutions = [ChainConvolution(width, key=key) for key in keys]
        self.head = eqx.nn.MLP(2 * width + config.globals, 1, width, 1, key=head_key)
        self.calibration = Calibration()
        self.threshold = jnp.array(0.5)
        self.config = config

    def logit(self, obstacles: Obstacles, transition: Transition) -> Float[Array, ""]:
        """The network's own output, before calibration."""
        chain, whole = self.inputs(obstacles, transition)
        return self.head(jnp.concatenate([self.encode(chain), whole]))[0]

    def encode(self, chain: Float[Array, "L f"]) -> Float[Array, "e"]:
        """The chain's features, summed up."""
        x = jax.nn.relu(jax.vmap(self.embed)(chain))
        for convolution in self.convolutions:
            x = convolution(x)
        return jnp.concatenate([x.mean(0), x.max(0)])

    def inputs(
        self, obstacles: Obstacles, transition: Transition
    ) -> tuple[Float[Array, "L f"], Float[Array, "g"]]:
        """What the network sees: per point of the chain, and of the transition as a whole."""
        state, action = transition.state, transition.action
        frame = local_frame(state, action, self.config.origin, "canonical")
        begin, end = (chain_of(one, self.config.midpoints) for one in (state, transition.next_state))
        moments = jnp.linspace(0.0, 1.0, self.config.moments)[:, None, None]
        x, y, z = jnp.moveaxis(begin[None] + moments * (end - begin)[None], -1, 0)
        distance, *gradient = signed_distance_and_gradient(obstacles, x, y, z)
        weight = jnp.exp(-jnp.maximum(distance, 0.0) / FAR)  # far away, directions mean nothing
        away = weight[None] * jnp.moveaxis(frame.vectors_in(jnp.stack(gradient, axis=-1)), -1, 0)
        seen = jnp.stack([jnp.tanh(distance / NEAR), jnp.tanh(distance / FAR), *away], axis=1)
        chain = jnp.concatenate(  # features first, as long axes are fast
            [
                jnp.linspace(-1.0, 1.0, len(begin))[None],
                frame.points_in(begin).T / 0.2,
                frame.vectors_in(end - begin).T / 0.05,
                seen.reshape(-1, len(begin)),
            ]
        ).T
        whole = jnp.append(
            frame.vectors_in(action).reshape(-1) / 0.1, jnp.log(transition.uncertainty + 1e-4) + 3
        )
        return chain, whole
