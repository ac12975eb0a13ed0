"""What a learner predicts of a container that pours: a residual network, and a judge of its errors."""

from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from doojax.geometry.sdf import signed_distance
from doojax.models.dynamics import with_scales
from doojax.modules import Jittable
from doojax.types import Depth, Obstacles, PouringState, Size, Transition

SEEN, PREDICTED = 12, 5  # numbers in and out
STEPS = 5  # places on the way at which a judge looks around
STREAM = 6  # places below the rim at which it does
NEAR = 0.1  # m: what is farther looks alike


@dataclass(frozen=True)
class PouringConfig:
    """What a `PouringDynamics` is built from."""

    width: Size = 128
    depth: Depth = 3  # hidden layers
    what: Literal["pouring"] = "pouring"  # tells it in a model's file from those of ropes


@dataclass(frozen=True)
class PouringJudgeConfig:
    """What a `PouringJudge` is built from."""

    width: Size = 64
    depth: Depth = 2
    what: Literal["pouring"] = "pouring"


class PouringDynamics(Jittable):
    """Next state = where it is sent + change(state, action); obstacles are not looked at.

    Thesis section 4.4.2: a fully connected network. What it sees is relative to the receiver, so that moving
    everything changes nothing.
    """

    network: eqx.nn.MLP
    input_mean: Float[Array, "i"]
    input_scale: Float[Array, "i"]
    output_scale: Float[Array, "o"]
    config: PouringConfig = eqx.field(static=True)

    def __init__(self, config: PouringConfig, *, key: Array):
        """Random weights."""
        self.network = eqx.nn.MLP(SEEN, PREDICTED, config.width, config.depth, key=key)
        self.input_mean, self.input_scale = jnp.zeros(SEEN), jnp.ones(SEEN)
        self.output_scale = jnp.ones(PREDICTED)
        self.config = config

    def __call__(
        self, obstacles: Obstacles | None, state: PouringState, action: Float[Array, "1 3"]
    ) -> tuple[PouringState, Float[Array, ""]]:
        """See `doojax.models.protocols.Dynamics`; one network alone has no doubts: 0."""
        inputs = (seen(state, action) - stop_gradient(self.input_mean)) / stop_gradient(self.input_scale)
        change = self.network(inputs) * stop_gradient(self.output_scale)
        sent = sent_to(state, action)
        place = sent.container + jnp.stack([change[0], jnp.zeros(()), change[1]])
        volumes = jnp.clip(state.volumes + change[3:], 0.0, 1.0)
        after = PouringState(place, sent.angle + change[2], state.receiver, volumes, state.size)
        return after, jnp.zeros(())

    def scaled_to(
        self, states: PouringState, actions: Float[Array, "n 1 3"], after: PouringState
    ) -> "PouringDynamics":
        """The same network, for inputs and outputs shifted and scaled by those of n transitions."""

        def change(state: PouringState, action: Array, after: PouringState) -> Array:
            sent = sent_to(state, action)
            way = (after.container - sent.container)[::2]
            return jnp.concatenate([way, (after.angle - sent.angle)[None], after.volumes - state.volumes])

        inputs = jax.vmap(seen)(states, actions)
        return with_scales(self, inputs, jax.vmap(change)(states, actions, after))


class PouringJudge(Jittable):
    """A network that looks at a predicted transition and at what is around: for `DeviationEstimator`."""

    network: eqx.nn.MLP

    def __init__(self, config: PouringJudgeConfig, *, key: Array):
        """Random weights."""
        inputs = SEEN + 5 + 1 + 2 * STEPS + STREAM
        self.network = eqx.nn.MLP(inputs, "scalar", config.width, config.depth, key=key)

    def logit(self, obstacles: Obstacles, transition: Transition) -> Float[Array, ""]:
        """A number of its own unit."""
        before, after, action = transition.state, transition.next_state, transition.action
        way = jnp.linspace(0.0, 1.0, STEPS)[:, None]
        sent = sent_to(before, action)
        straight = jax.vmap(lambda part: _between(before, sent, part))(way[:, 0])
        around = signed_distance(obstacles, straight.bodies()[:, 3:]).min(1)
        middle = signed_distance(obstacles, straight.bodies()[:, 3:].mean(1))
        rim = sent.bodies()[5:].mean(0)
        down = jnp.linspace(0.0, rim[2] - sent.receiver[2], STREAM)
        below = signed_distance(obstacles, rim - down[:, None] * jnp.array([0.0, 0.0, 1.0]))
        near = jnp.concatenate([around, middle, below])
        off = (after.container - sent.container)[::2]
        predicted = jnp.concatenate([off, after.angle[None], after.volumes])
        doubt = jnp.log(transition.uncertainty + 1e-4)[None]
        around = jnp.clip(near / NEAR, -1.0, 3.0)
        return self.network(jnp.concatenate([seen(before, action), predicted, doubt, around]))


def sent_to(state: PouringState, action: Float[Array, "1 3"]) -> PouringState:
    """Where a container would be that gets where it is sent, nothing poured."""
    place = state.container + jnp.stack([action[0, 0], jnp.zeros(()), action[0, 1]])
    return PouringState(place, action[0, 2], state.receiver, state.volumes, state.size)


def seen(state: PouringState, action: Float[Array, "1 3"]) -> Float[Array, "i"]:
    """What a network sees: places in decimetres from the receiver, angles as directions.

    Not the container's size: of one container's data it has one value, and would mean nothing with another.
    """
    sent = sent_to(state, action)
    here, there = (state.container - state.receiver)[::2], (sent.container - state.receiver)[::2]
    return jnp.concatenate(
        [
            10 * here,
            10 * there,
            10 * (there - here),
            _direction(state.angle),
            _direction(sent.angle),
            state.volumes,
        ]
    )


def _between(state: PouringState, sent: PouringState, part: Float[Array, ""]) -> PouringState:
    place = state.container + part * (sent.container - state.container)
    angle = state.angle + part * (sent.angle - state.angle)
    return PouringState(place, angle, state.receiver, state.volumes, state.size)


def _direction(angle: Float[Array, ""]) -> Float[Array, "2"]:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])
