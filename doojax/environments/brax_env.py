"""A task as a `brax.envs.Env`, for whatever trains on those; needs the extra ``rl``."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from doojax.environments.base import Environment, EnvironmentState
from doojax.optional import advice
from doojax.simulation.engines.quiet_mjx import mjx as mjx  # before brax imports it, which would print

try:
    from brax.envs.base import Env, State
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(advice(error), name=error.name) from error


class BraxEnvironment(Env):
    """An `Environment` whose engine is pure: mjx, warp, or that of the task toy.

    Episodes end at the goal and where a simulation becomes unstable. brax's own wrapper counts their steps.
    Metrics of a step: ``reached``, 0 or 1, and ``missing``, metres to the goal.
    """

    def __init__(self, environment: Environment):
        """Show ``environment`` to brax.

        Raises:
            ValueError: its engine runs outside of jit.
        """
        if not isinstance(environment.simulator, eqx.Module):
            raise ValueError(
                "brax needs an engine that runs inside of jit: make_environment(..., engine='mjx') or 'warp'"
            )
        self.environment = environment

    def reset(self, rng: jax.Array) -> State:
        """A start, from a random key of either kind."""
        key = rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)
        return self._shown(self.environment.reset(key))

    def step(self, state: State, action: jax.Array) -> State:
        """One control period."""
        before: Any = state.pipeline_state  # brax has States of its own there
        after: Any = self._shown(self.environment.step(before, action))
        return after.replace(info=state.info, metrics={**state.metrics, **after.metrics})

    def _shown(self, state: EnvironmentState) -> State:
        metrics = {"reached": state.reached.astype(jnp.float32), "missing": state.missing}
        done = state.done.astype(jnp.float32)
        pipeline: Any = state
        return State(pipeline, state.observation, state.reward, done, metrics)

    @property
    def observation_size(self) -> int:
        """How long an observation is."""
        return self.environment.observation_size

    @property
    def action_size(self) -> int:
        """How many numbers an action is."""
        return self.environment.action_size

    @property
    def backend(self) -> str:
        """What simulates."""
        return type(self.environment.simulator).__name__
