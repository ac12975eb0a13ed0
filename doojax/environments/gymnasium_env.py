"""A task as a gymnasium environment, one or many at once; needs the extra ``rl``."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from doojax.environments.base import Environment, EnvironmentState, chosen
from doojax.keys import numbered, stream
from doojax.optional import advice

try:
    import gymnasium
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(advice(error), name=error.name) from error

STEPS = 50  # of an episode


class VectorEnvironment(VectorEnv):
    """B episodes side by side, on any engine; one that ended begins anew with the next step.

    What an action or an observation means, `doojax.environments` says. Episodes are terminated at the goal
    and where a simulation becomes unstable, and truncated after so many steps. An episode's start depends on
    the seed, its place in the batch and its number there alone.
    """

    def __init__(self, environment: Environment, count: int, steps: int = STEPS):
        """Show ``count`` of ``environment``.

        Raises:
            ValueError: a count or a number of steps below 1.
        """
        if count < 1 or steps < 1:
            raise ValueError(f"count is {count} and steps {steps}, expected at least 1 of each")
        self.environment, self.num_envs, self.steps = environment, count, steps
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}
        self.single_observation_space = Box(-np.inf, np.inf, (environment.observation_size,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (environment.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)
        self._state: EnvironmentState | None = None
        self._seed, self._begun = 0, np.zeros(count, int)
        self._lasted, self._over = np.zeros(count, int), np.zeros(count, bool)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, "B D"], dict[str, Any]]:
        """All begin anew; the same seed begins the same episodes, none goes on to the next ones."""
        if seed is not None:
            self._seed, self._begun[:] = seed if isinstance(seed, int) else seed[0], 0
        elif self._state is None:
            self._seed = int(np.random.default_rng().integers(2**31))
        self._state = self._drawn()
        self._begun += 1
        self._lasted[:], self._over[:] = 0, False
        return self._seen(self._state), self._info(self._state)

    def step(
        self, actions: Float[np.ndarray, "B U"]
    ) -> tuple[
        Float[np.ndarray, "B D"],
        Float[np.ndarray, "B"],
        Bool[np.ndarray, "B"],
        Bool[np.ndarray, "B"],
        dict[str, Any],
    ]:
        """One control period of all, but for those that begin anew.

        Raises:
            gymnasium.error.ResetNeeded: `reset` was never called.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        after = self.environment.advance(self._state, jnp.asarray(actions, jnp.float32))
        anew = self._over.copy()
        if anew.any():
            after = chosen(jnp.asarray(anew), self._drawn(), after)
            self._begun[anew] += 1
        self._lasted = np.where(anew, 0, self._lasted + 1)
        self._state = after
        terminated = np.asarray(after.done) & ~anew
        truncated = (self._lasted >= self.steps) & ~terminated
        self._over = terminated | truncated
        reward = np.where(anew, 0.0, np.asarray(after.reward, np.float64))
        return self._seen(after), reward, terminated, truncated, self._info(after)

    def _drawn(self) -> EnvironmentState:
        """The episode with which each would begin anew."""
        places = stream(self._seed, "gymnasium", self.environment.task.name)
        keys = jax.vmap(jax.random.fold_in)(numbered(places, range(self.num_envs)), jnp.asarray(self._begun))
        return self.environment.begin(keys)

    @staticmethod
    def _seen(state: EnvironmentState) -> Float[np.ndarray, "B D"]:
        return np.asarray(state.observation, np.float32)

    @staticmethod
    def _info(state: EnvironmentState) -> dict[str, Any]:
        return {"reached": np.asarray(state.reached), "missing": np.asarray(state.missing)}


class SingleEnvironment(gymnasium.Env):
    """One episode after another: a `VectorEnvironment` of one, which the caller resets."""

    def __init__(self, environment: Environment, steps: int = STEPS):
        """Show ``environment``."""
        self._vector = VectorEnvironment(environment, 1, steps)
        self.metadata = {"render_modes": []}
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, "D"], dict[str, Any]]:
        """A new episode; see `VectorEnvironment.reset`."""
        super().reset(seed=seed)
        observations, info = self._vector.reset(seed=seed)
        return observations[0], _first(info)

    def step(
        self, action: Float[np.ndarray, "U"]
    ) -> tuple[Float[np.ndarray, "D"], float, bool, bool, dict[str, Any]]:
        """One control period."""
        observations, rewards, terminated, truncated, info = self._vector.step(action[None])
        return observations[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), _first(info)


def _first(info: dict[str, Any]) -> dict[str, Any]:
    return {name: values[0].item() for name, values in info.items()}
