"""Several networks trained from different seeds: their mean predicts, their spread says how sure it is."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.models.protocols import Dynamics
from doojax.models.rolling import roll_out
from doojax.modules import Jittable


class Ensemble(Jittable):
    """The mean of E members and the sum over all coordinates of the standard deviation among them.

    Thesis section 2.3.2.1, which writes the summed standard deviation as sigma^2; its unit here is the metre.
    The deviation is that of the population, not the sample.

    In the released code each member rolls out on its own when data are labelled, but all of them start each
    step from their mean when planning, so that the classifier meets other uncertainties than it was trained
    on. Here one step from one state is the only thing an ensemble does, `doojax.models.rolling.roll_out`
    repeats it, and labels are made from that; `roll_out_members` is kept for comparison.
    """

    members: Any  # any dynamics, of which every array has a leading axis E

    @property
    def size(self) -> int:
        """Number of members, E."""
        return jax.tree.leaves(eqx.filter(self.members, eqx.is_array))[0].shape[0]

    def __call__(
        self, obstacles: Any, state: Any, action: Float[Array, "..."]
    ) -> tuple[Any, Float[Array, ""]]:
        """See `doojax.models.protocols.Dynamics`; what members say of their own doubts is left out."""

        def predict(member: Dynamics) -> Any:
            return member(obstacles, state, action)[0]

        return summary(eqx.filter_vmap(predict)(self.members))

    def roll_out_members(
        self, obstacles: Any, state: Any, actions: Float[Array, "T ..."]
    ) -> tuple[Any, Float[Array, "T"]]:
        """T steps of each member on its own; mean and spread are taken at each time, as the thesis does."""

        def alone(member: Dynamics) -> Any:
            return roll_out(member, obstacles, state, actions)[0]

        means, spread = jax.vmap(summary, in_axes=1)(eqx.filter_vmap(alone)(self.members))
        return means, spread[1:]


def summary(states: Any) -> tuple[Any, Float[Array, ""]]:
    """Mean of E states, and the sum over all coordinates of their standard deviation."""
    spread = [leaf.std(0).sum() for leaf in jax.tree.leaves(states)]
    return jax.tree.map(lambda leaf: leaf.mean(0), states), jnp.stack(spread).sum()
