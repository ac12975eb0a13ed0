"""Several networks trained from different seeds: their mean predicts, their spread says how sure it is."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.models.dynamics import UnconstrainedDynamics
from doojax.modules import Jittable
from doojax.types import Obstacles, RopeState


class Ensemble(Jittable):
    """The mean of E members and the sum over all coordinates of the standard deviation among them.

    Thesis section 2.3.2.1, which writes the summed standard deviation as sigma^2; its unit here is the metre.
    The deviation is that of the population, not the sample.

    In the released code each member rolls out on its own when data are labelled, but all of them start each
    step from their mean when planning, so that the classifier meets other uncertainties than it was trained
    on. Here one step from one state is the only thing an ensemble does, `roll_out` repeats it, and labels are
    made from that; `roll_out_members` is kept for comparison.
    """

    members: UnconstrainedDynamics  # every array has a leading axis E

    @property
    def size(self) -> int:
        """Number of members, E."""
        return self.members.input_mean.shape[0]

    def __call__(
        self, obstacles: Obstacles | None, state: RopeState, action: Float[Array, "G 3"]
    ) -> tuple[RopeState, Float[Array, ""]]:
        """See `doojax.models.protocols.Dynamics`."""
        return summary(eqx.filter_vmap(lambda member: member.predict(state, action))(self.members))

    def roll_out(
        self, state: RopeState, actions: Float[Array, "T G 3"]
    ) -> tuple[RopeState, Float[Array, "T"]]:
        """T steps, each from the mean that the last one predicted: what a planner does.

        Returns:
            the T + 1 states, the first of which is given, and the uncertainty of each step.
        """

        def step(state: RopeState, action: Array):
            after, uncertainty = self(None, state, action)
            return after, (after, uncertainty)

        _, (states, uncertainty) = jax.lax.scan(step, state, actions)
        return with_first(state, states), uncertainty

    def roll_out_members(
        self, state: RopeState, actions: Float[Array, "T G 3"]
    ) -> tuple[RopeState, Float[Array, "T"]]:
        """T steps of each member on its own; mean and spread are taken at each time, as the thesis does."""
        members = eqx.filter_vmap(lambda member: roll_out(member, state, actions))(self.members)
        means, spread = jax.vmap(summary, in_axes=1)(members)
        return means, spread[1:]


def roll_out(member: UnconstrainedDynamics, state: RopeState, actions: Float[Array, "T G 3"]) -> RopeState:
    """The T + 1 states that one network predicts, the first of which is given."""

    def step(state: RopeState, action: Array):
        after = member.predict(state, action)
        return after, after

    return with_first(state, jax.lax.scan(step, state, actions)[1])


def with_first(state: RopeState, states: RopeState) -> RopeState:
    """T states with one put before them."""
    return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), state, states)


def summary(states: RopeState) -> tuple[RopeState, Float[Array, ""]]:
    """Mean of E states, and the sum over all coordinates of their standard deviation."""
    spread = [leaf.std(0).sum() for leaf in jax.tree.leaves(states)]
    return jax.tree.map(lambda leaf: leaf.mean(0), states), jnp.stack(spread).sum()
