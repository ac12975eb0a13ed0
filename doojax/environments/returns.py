"""What a policy gains in an episode, on any engine."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.environments.base import Environment
from doojax.keys import numbered

AT_ONCE = 64  # episodes side by side

Acts = Callable[[Float[Array, "B D"], Array], Float[Array, "B U"]]
"""What B episodes are given, numbers from -1 to 1, of their observations and a random key."""


class Episodes(NamedTuple):
    """What came of E episodes."""

    gained: Float[np.ndarray, "E"]  # the sum of rewards, see `Environment`
    reached: Bool[np.ndarray, "E"]  # the goal, in time


def random_acts(environment: Environment) -> Acts:
    """Each number uniform from -1 to 1, whatever is seen."""
    size = environment.action_size
    return lambda seen, key: jax.random.uniform(key, (len(seen), size), minval=-1.0, maxval=1.0)


def episodes(environment: Environment, acts: Acts, key: Array, count: int, steps: int) -> Episodes:
    """``count`` episodes of at most ``steps`` control periods.

    The same key gives the same starts and goals to every policy, in the same order.
    """
    gained, reached = [], []
    start_key, act_key = jax.random.split(key)
    for first in range(0, count, AT_ONCE):
        states = environment.begin(numbered(start_key, range(first, min(count, first + AT_ONCE))))
        total, over = np.zeros(len(states.done)), np.zeros(len(states.done), bool)
        arrived = over.copy()
        for step in range(steps):
            if over.all():
                break
            here = jax.random.fold_in(jax.random.fold_in(act_key, first), step)
            states = environment.advance(states, jnp.asarray(acts(states.observation, here)))
            total += np.where(over, 0.0, np.asarray(states.reward))
            arrived |= ~over & np.asarray(states.reached)
            over |= np.asarray(states.done)
        gained.append(total)
        reached.append(arrived)
    return Episodes(np.concatenate(gained), np.concatenate(reached))
