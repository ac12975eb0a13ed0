"""PropNet for bodies that a hand pushes about (Li et al. 2019, as in the thesis's section 3.5).

Bodies are nodes of a graph, and every two within reach of each other are joined, both ways. Effects are
passed along the joints a few times; what is predicted is how far each body moves.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from doojax.modules import Jittable
from doojax.types import Depth, Obstacles, PushingState, Size

TINY = 1e-12


@dataclass(frozen=True)
class PropNetConfig:
    """Sizes of a network; the defaults are the thesis's."""

    bodies: Size  # without the hand
    period: float  # s, of an action
    radius: float = 0.02  # m, of all
    reach: float = 0.05  # m, between centres, within which two are joined
    particle: Size = 100  # width of what a node knows of itself
    relation: Size = 150  # of what a joint knows of itself
    effect: Size = 100  # of what is passed on
    passes: Depth = 5
    joints: Size | None = None  # of all ordered pairs at most so many are looked at, the nearest; None: all
    position_unit: float = 1.0  # m; 1: the network sees metres
    motion_unit: float = 1.0  # m, of a period's motion


class PropNet(Jittable):
    """A `doojax.models.protocols.Dynamics` of `PushingState`; obstacles are not looked at."""

    of_particle: eqx.nn.MLP
    of_relation: eqx.nn.MLP
    relation_effect: eqx.nn.Linear
    receiver_effect: eqx.nn.Linear
    sender_effect: eqx.nn.Linear
    particle_effect: eqx.nn.Linear
    received_effect: eqx.nn.Linear
    predictor: eqx.nn.MLP
    config: PropNetConfig = eqx.field(static=True)

    def __init__(self, config: PropNetConfig, *, key: Array):
        """Random weights."""
        keys = jax.random.split(key, 8)
        particle, relation, effect = config.particle, config.relation, config.effect
        self.config = config
        self.of_particle = _encoder(6, particle, 1, keys[0])
        self.of_relation = _encoder(8, relation, 2, keys[1])
        # a linear layer of three things side by side is the sum of one of each
        self.relation_effect = eqx.nn.Linear(relation, effect, key=keys[2])
        self.receiver_effect = eqx.nn.Linear(effect, effect, use_bias=False, key=keys[3])
        self.sender_effect = eqx.nn.Linear(effect, effect, use_bias=False, key=keys[4])
        self.particle_effect = eqx.nn.Linear(particle, effect, key=keys[5])
        self.received_effect = eqx.nn.Linear(effect, effect, use_bias=False, key=keys[6])
        self.predictor = eqx.nn.MLP(effect, 2, particle, 1, key=keys[7])

    def __call__(
        self, obstacles: Obstacles | None, state: PushingState, action: Float[Array, "1 3"]
    ) -> tuple[PushingState, Float[Array, ""]]:
        """The state a period later; the hand gets where it is sent, and nothing is said of doubt."""
        period = self.config.period
        move = self.moves(
            jnp.concatenate([state.positions, state.hand[None]])[:, :2],
            jnp.concatenate([state.velocities[:, :2] * period, action[:, :2]]),
        )
        along = jnp.concatenate([move, jnp.zeros((len(move), 1))], axis=1)
        hand = state.hand + action[0].at[2].set(0.0)
        return PushingState(state.positions + along, along / period, hand), jnp.zeros(())

    def moves(self, places: Float[Array, "K 2"], before: Float[Array, "K 2"]) -> Float[Array, "N 2"]:
        """How far each body moves in a period, m.

        Args:
            places: in the plane, m: of the N bodies, then of the hand.
            before: how far each body moved in the period before; and the hand's move in the coming one.
        """
        config, count = self.config, len(places)
        receivers, senders, joined = self._joints(places)
        position, motion = places / config.position_unit, before / config.motion_unit
        attributes = jnp.stack(
            [jnp.full(count, config.radius / config.position_unit), jnp.arange(count) == count - 1], axis=1
        )
        node = jnp.concatenate([attributes, position, motion], axis=1)
        # looked up by products, which a CPU does faster than gathers and scatters
        to = jax.nn.one_hot(receivers, count)
        of = jax.nn.one_hot(senders, count)
        apart = (to - of) @ node[:, 2:]
        joint = jnp.concatenate([to @ attributes, of @ attributes, apart], axis=1)
        known = jax.vmap(self.of_particle)(node)
        relation = jax.vmap(self.relation_effect)(jax.vmap(self.of_relation)(joint))
        own, collect = jax.vmap(self.particle_effect)(known), (to * joined[:, None]).T
        effect = jnp.zeros_like(own)
        for _ in range(config.passes):
            passed = to @ jax.vmap(self.receiver_effect)(effect) + of @ jax.vmap(self.sender_effect)(effect)
            received = collect @ jax.nn.relu(relation + passed)
            effect = jax.nn.relu(own + jax.vmap(self.received_effect)(received))
        return config.motion_unit * jax.vmap(self.predictor)(effect[:-1])

    def _joints(
        self, places: Float[Array, "K 2"]
    ) -> tuple[Int[Array, "R"], Int[Array, "R"], Bool[Array, "R"]]:
        """Receivers, senders, and which of these pairs are within reach."""
        count, most = len(places), self.config.joints
        receivers, senders = (jnp.asarray(index) for index in np.nonzero(~np.eye(count, dtype=bool)))
        offset = places[receivers] - places[senders]
        gap = jnp.sqrt((offset**2).sum(-1) + TINY)
        if most is not None and most < len(gap):
            _, nearest = jax.lax.top_k(-jax.lax.stop_gradient(gap), most)
            receivers, senders, gap = receivers[nearest], senders[nearest], gap[nearest]
        return receivers, senders, gap < self.config.reach


def pushed_along(
    model: PropNet,
    places: Float[Array, "K 2"],
    before: Float[Array, "K 2"],
    hands: Float[Array, "T 2"],
    hand_moves: Float[Array, "T 2"],
) -> tuple[Float[Array, "T N 2"], Float[Array, "T N 2"]]:
    """T periods on its own predictions, with the hand's true places and moves: places after, and moves.

    Args:
        model: the network.
        places: of bodies and hand at first, m.
        before: how far the bodies moved in the period before; the hand's does not count.
        hands: before each period, m.
        hand_moves: in each period, m.
    """

    def period(carry: tuple[Array, Array], given: tuple[Array, Array]) -> tuple:
        at, moved = carry
        hand, move = given
        now = model.moves(jnp.concatenate([at, hand[None]]), jnp.concatenate([moved, move[None]]))
        return (at + now, now), (at + now, now)

    _, found = jax.lax.scan(period, (places[:-1], before[:-1]), (hands, hand_moves))
    return found


def _encoder(inputs: int, width: int, depth: int, key: Array) -> eqx.nn.MLP:
    return eqx.nn.MLP(inputs, width, width, depth, final_activation=jax.nn.relu, key=key)
