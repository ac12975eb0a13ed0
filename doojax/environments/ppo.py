"""Proximal policy optimisation, on any engine; needs the extra ``rl``.

The loss, networks and scaling of observations are brax's. Its loop is not: it runs inside of jit, where
MuJoCo C, which is many times as fast as MJX on a CPU, cannot; and it cannot go on where it was killed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from doojax.environments.base import Environment, EnvironmentState, chosen
from doojax.keys import numbered, stream
from doojax.models.policy import Policy, PolicyConfig
from doojax.optional import advice
from doojax.simulation.engines.quiet_mjx import mjx as mjx  # before brax imports it, which would print

try:
    from brax.training import gradients as brax_gradients
    from brax.training import types as brax_types
    from brax.training.acme import running_statistics, specs
    from brax.training.agents.ppo import losses as brax_losses
    from brax.training.agents.ppo import networks as brax_networks
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(advice(error), name=error.name) from error

# what these declare is narrower than what they take
losses: Any = brax_losses
networks: Any = brax_networks
gradients: Any = brax_gradients
types: Any = brax_types

PURPOSE = ("train", "ppo")  # of the random streams
MINIBATCHES, PASSES = 4, 4  # of an update: in how many parts, how often
LEAST_SPREAD = 0.01  # m: what an observation's coordinate is divided by, at least
MOST_CHANGE = 1.0  # norm of a gradient, beyond which it is shortened


@dataclass(frozen=True)
class PpoSettings:
    """How a policy is trained; the defaults are for two cores."""

    steps: int = 200_000  # control periods in all, whole updates
    environments: int = 32  # side by side
    episode: int = 30  # control periods at most
    unroll: int = 8  # control periods between updates
    width: int = 64  # of hidden layers
    depth: int = 3  # how many
    learning_rate: float = 1e-3
    entropy: float = 3e-3  # what an action's spread is worth
    discount: float = 0.97

    def __post_init__(self):
        """Refuse what trains nothing."""
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} is {value}, expected more than 0")

    @property
    def updates(self) -> int:
        """How many there are, at least one."""
        return max(1, round(self.steps / (self.environments * self.unroll)))

    @property
    def whole_steps(self) -> int:
        """Control periods of that many updates."""
        return self.updates * self.environments * self.unroll


class Learner(NamedTuple):
    """All that goes on from one update to the next: arrays alone."""

    parameters: Any  # brax's PPONetworkParams
    scaling: running_statistics.RunningStatisticsState
    optimiser: Any
    states: EnvironmentState
    lasted: Int[Array, "B"]  # control periods of each episode so far
    begun: Int[Array, "B"]  # how many episodes each place began
    gained: Float[Array, "B"]  # the return of each episode so far


class Ppo:
    """Trains a policy in an environment, update by update; the same seed gives the same weights."""

    def __init__(self, environment: Environment, settings: PpoSettings, seed: int):
        """Prepare to train; runs nothing yet.

        Args:
            environment: what the policy is to do.
            settings: how it learns.
            seed: of everything that is random.

        Raises:
            ValueError: environments side by side that are no multiple of 4, the minibatches.
        """
        if settings.environments % MINIBATCHES:
            text = f"expected a multiple of {MINIBATCHES}, the minibatches"
            raise ValueError(f"environments is {settings.environments}, {text}")
        self.environment, self.settings = environment, settings
        size, actions = environment.observation_size, environment.action_size
        hidden = (settings.width,) * settings.depth
        self.config = PolicyConfig(size, actions, settings.width, settings.depth)
        self._networks = networks.make_ppo_networks(
            size,
            actions,
            preprocess_observations_fn=running_statistics.normalize,
            policy_hidden_layer_sizes=hidden,
            value_hidden_layer_sizes=hidden,
        )
        self._optimiser = optax.chain(
            optax.clip_by_global_norm(MOST_CHANGE), optax.adam(settings.learning_rate)
        )
        self._keys = partial(stream, seed, *PURPOSE, environment.task.name)
        self._acts, self._mended, self._made = (jax.jit(f) for f in (self._act, self._mend, self._fresh))

    def begin(self) -> Learner:
        """Fresh weights, and the first episodes."""
        count = self.settings.environments
        parameters, scaling, optimiser = self._made(self._keys("weights"))
        none = jnp.zeros(count, jnp.int32)
        states = self._episodes(none)
        return Learner(parameters, scaling, optimiser, states, none, none + 1, jnp.zeros(count))

    def update(self, learner: Learner, number: int) -> tuple[Learner, Float[np.ndarray, "E"]]:
        """Collect with the policy as it is, then mend it.

        Returns:
            what goes on, and the returns of the E episodes that ended meanwhile.
        """
        rows, ended = [], []
        for period in range(self.settings.unroll):
            key = jax.random.fold_in(jax.random.fold_in(self._keys("acts"), number), period)
            learner, row, over, gained = self._period(learner, key)
            rows.append(row)
            ended.append(np.asarray(gained)[over])
        data = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1), *rows)
        key = jax.random.fold_in(self._keys("learns"), number)
        before = (learner.parameters, learner.scaling, learner.optimiser)
        parameters, scaling, optimiser = self._mended(before, data, key)
        mended = learner._replace(parameters=parameters, scaling=scaling, optimiser=optimiser)
        return mended, np.concatenate(ended)

    def policy(self, learner: Learner) -> Policy:
        """What has been learned."""
        return policy_of(self.config, learner.scaling, learner.parameters.policy)

    def _period(self, learner: Learner, key: Array) -> tuple[Learner, Any, np.ndarray, Float[Array, "B"]]:
        """One control period of all episodes; those that are over then begin anew."""
        before = learner.states.observation
        action, extras = self._acts((learner.scaling, learner.parameters.policy), before, key)
        after = self.environment.advance(learner.states, action)
        lasted, gained = learner.lasted + 1, learner.gained + after.reward
        truncated = (lasted >= self.settings.episode) & ~after.done
        over = after.done | truncated
        row = types.Transition(
            observation=before,
            action=action,
            reward=after.reward,
            discount=1.0 - over,
            next_observation=after.observation,
            extras={
                "policy_extras": extras,
                "state_extras": {"truncation": truncated.astype(jnp.float32)},
            },
        )
        states, ends = after, np.asarray(over)
        if ends.any():
            states = chosen(over, self._episodes(learner.begun), after)
        on = learner._replace(
            states=states,
            lasted=jnp.where(over, 0, lasted),
            begun=learner.begun + over,
            gained=jnp.where(over, 0.0, gained),
        )
        return on, row, ends, gained

    def _episodes(self, numbers: Int[Array, "B"]) -> EnvironmentState:
        """The episode of each place that has a number there."""
        places = numbered(self._keys("episodes"), range(len(numbers)))
        return self.environment.begin(jax.vmap(jax.random.fold_in)(places, numbers))

    def _fresh(self, key: Array) -> tuple[Any, Any, Any]:
        policy_key, value_key = jax.random.split(key)
        parameters = losses.PPONetworkParams(
            policy=self._networks.policy_network.init(policy_key),
            value=self._networks.value_network.init(value_key),
        )
        scaling = running_statistics.init_state(specs.Array((self.config.observation,), jnp.dtype("float32")))
        return parameters, scaling, self._optimiser.init(parameters)

    def _act(self, parameters: Any, observations: Float[Array, "B D"], key: Array) -> tuple[Array, Any]:
        return networks.make_inference_fn(self._networks)(parameters)(observations, key)

    def _mend(self, weights: tuple[Any, Any, Any], data: Any, key: Array) -> tuple[Any, Any, Any]:
        """Several passes over what was collected, [B, T, ...], in parts."""
        parameters, scaling, optimiser = weights
        scaling = running_statistics.update(scaling, data.observation, std_min_value=LEAST_SPREAD)
        loss = partial(
            losses.compute_ppo_loss,
            ppo_network=self._networks,
            entropy_cost=self.settings.entropy,
            discounting=self.settings.discount,
        )
        gradient_step = gradients.gradient_update_fn(loss, self._optimiser, pmap_axis_name=None, has_aux=True)

        def part(carry, given):
            rows, key = given
            _, parameters, optimiser = gradient_step(carry[0], scaling, rows, key, optimizer_state=carry[1])
            return (parameters, optimiser), None

        def once(carry, key):
            order_key, loss_key = jax.random.split(key)
            order = jax.random.permutation(order_key, self.settings.environments)
            parts = jax.tree.map(lambda x: x[order].reshape(MINIBATCHES, -1, *x.shape[1:]), data)
            return jax.lax.scan(part, carry, (parts, jax.random.split(loss_key, MINIBATCHES)))

        (parameters, optimiser), _ = jax.lax.scan(
            once, (parameters, optimiser), jax.random.split(key, PASSES)
        )
        return parameters, scaling, optimiser


def policy_of(config: PolicyConfig, scaling: Any, parameters: Mapping[str, Any]) -> Policy:
    """brax's parameters of a policy as a `Policy`: of its outputs the locations, not the spreads."""
    policy = Policy(config, key=stream(0, "structure"))
    layers = []
    for index, layer in enumerate(policy.network.layers):
        theirs = parameters["params"][f"hidden_{index}"]
        weight, bias = jnp.asarray(theirs["kernel"]).T, jnp.asarray(theirs["bias"])
        size = layer.weight.shape[0]  # the last layer gives locations, then spreads
        layers.append(eqx.tree_at(lambda one: (one.weight, one.bias), layer, (weight[:size], bias[:size])))
    learned = jnp.asarray(scaling.mean), jnp.asarray(scaling.std), tuple(layers)
    return eqx.tree_at(lambda one: (one.mean, one.scale, one.network.layers), policy, learned)
