"""What to do where nothing is reliable (thesis section 2.3.6)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.actions import nothing_of, sampled
from doojax.models.protocols import Recovery
from doojax.modules import Jittable
from doojax.planning.protocols import Task
from doojax.types import Obstacles, State

SAMPLES = 32  # actions that are compared


class RandomRecovery(Jittable):
    """Judges all actions alike: the baseline."""

    def __call__(self, obstacles: Obstacles, state: State, action: Float[Array, "..."]) -> Float[Array, ""]:
        """One half."""
        return jnp.full((), 0.5)


@eqx.filter_jit
def recovery_action(
    task: Task, recovery: Recovery, obstacles: Obstacles, state: State, *, key: Array
) -> Float[Array, "..."]:
    """Of some random actions the one that ``recovery`` rates highest, the first of equals.

    The released code of the thesis adds noise of 1 cm to the chosen action; here every call draws anew.
    """
    nothing = nothing_of(task.actions)
    keys = jax.random.split(key, SAMPLES)
    actions = jax.vmap(lambda key: sampled(task.actions, key, state, nothing))(keys)
    scores = jax.vmap(recovery, in_axes=(None, None, 0))(obstacles, state, actions)
    return actions[jnp.argmax(scores)]
