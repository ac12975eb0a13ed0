"""What to do where nothing is reliable (thesis section 2.3.6)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.models.protocols import Recovery
from doojax.modules import Jittable
from doojax.tasks.base import Task
from doojax.types import Obstacles, RopeState

SAMPLES = 32  # actions that are compared


class RandomRecovery(Jittable):
    """Judges all actions alike: the baseline."""

    def __call__(
        self, obstacles: Obstacles, state: RopeState, action: Float[Array, "G 3"]
    ) -> Float[Array, ""]:
        """One half."""
        return jnp.full((), 0.5)


@eqx.filter_jit
def recovery_action(
    task: Task, recovery: Recovery, obstacles: Obstacles, state: RopeState, *, key: Array
) -> Float[Array, "G 3"]:
    """Of some random actions the one that ``recovery`` rates highest, the first of equals.

    The released code of the thesis adds noise of 1 cm to the chosen action; here every call draws anew.
    """
    nothing = jnp.zeros((task.grippers, 3))
    actions = jax.vmap(task.sample_action, in_axes=(0, None, None, None))(
        jax.random.split(key, SAMPLES), state, nothing, "constrained"
    )
    scores = jax.vmap(recovery, in_axes=(None, None, 0))(obstacles, state, actions)
    return actions[jnp.argmax(scores)]
