"""Where predictions were right: the error, its threshold, labelled transitions (thesis 2.2.1, 2.3.4).

Where the thesis's text and its released code disagree, `LabelConfig` names the choice; `THESIS` is the
text's.
"""

from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from doojax.learning.data import Trajectories
from doojax.models.ensemble import Ensemble
from doojax.models.protocols import Dynamics
from doojax.models.rolling import roll_out
from doojax.types import State, Transition


def rms_distance(left: State, right: State) -> Float[Array, "*b"]:
    """The model error ``dist``: root mean square, over a rope's N points, of their distances in metres.

    Of any state, the passive bodies count, which are a rope's points.

    The released code takes the norm of all coordinates of the rope stacked into one vector, which is
    sqrt(N) times as large: its thresholds of 0.065 m (10 points) and 0.025 m (25 points) are 2.06 cm and
    0.50 cm here. Both leave the grippers out.
    """
    gaps = (left.bodies() - right.bodies())[..., : left.passive, :]
    return jnp.sqrt((gaps**2).sum(-1).mean(-1))


@dataclass(frozen=True)
class LabelConfig:
    """How trajectories become labelled transitions."""

    starts: Literal["every", "first"] = "every"
    """Predictions begin at every ``start_every``-th state (code), or only at a trajectory's first (text)."""
    start_every: int = 5
    horizon: int = 10  # steps that a prediction goes on for, at most
    discard: Literal["after first", "while far"] = "after first"
    """Drop all that follows a prediction's first error above the threshold (text), or only transitions that
    begin with such an error, so that those that come back into line are kept (code)."""
    rollout: Literal["mean", "members"] = "mean"
    """Each step begins with the ensemble's mean, as in planning, or each member goes on from its own."""

    def __post_init__(self):
        """Refuse what makes no transitions."""
        for name in ("start_every", "horizon"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")


THESIS = LabelConfig(starts="first", horizon=1_000_000, discard="after first", rollout="members")


class Examples(eqx.Module):
    """n predicted transitions, each with what became of it; whether it was right depends on the threshold."""

    transition: Transition  # [n]
    trajectory: Int[Array, "n"]  # which of the `Trajectories` it is from
    error: Float[Array, "n"]  # of the prediction, m
    error_before: Float[Array, "n"]  # of the state that it begins with, or the largest so far; see `discard`

    def __len__(self) -> int:
        """n."""
        return self.error.shape[0]

    def kept(self, threshold: Float[Array, ""] | float) -> Bool[Array, "n"]:
        """Which of them begin where the prediction was still right."""
        return self.error_before < threshold

    def right(self, threshold: Float[Array, ""] | float) -> Bool[Array, "n"]:
        """The label: which predictions are right."""
        return self.error < threshold


def error_threshold(ensemble: Ensemble, data: Trajectories, quantile: float = 0.9) -> float:
    """The model-error requirement's delta, metres: a quantile of the error where nothing is in the way.

    Over all steps of all trajectories and all members, each rolled out on its own as in training. The
    released code counts the error of the first state too, which is zero, and one member only.
    """
    return float(jnp.quantile(member_errors(ensemble, data), quantile))


def member_errors(ensemble: Ensemble, data: Trajectories) -> Float[Array, "E K T"]:
    """`rms_distance` of each member's prediction from each trajectory's first state, at steps 1 to T."""

    def one(member: Dynamics, data: Trajectories) -> Float[Array, "T"]:
        first = jax.tree.map(lambda leaf: leaf[0], data.states)
        return rms_distance(roll_out(member, data.obstacles, first, data.actions)[0], data.states)[1:]

    @eqx.filter_jit
    def every(members: Any, data: Trajectories):
        over_data = eqx.filter_vmap(one, in_axes=(None, 0))
        return eqx.filter_vmap(over_data, in_axes=(eqx.if_array(0), None))(members, data)

    return every(ensemble.members, data)


def label(dynamics: Dynamics, data: Trajectories, config: LabelConfig) -> Examples:
    """Predict along recorded trajectories and compare (figure 2.2): see `LabelConfig` for the choices."""
    length = data.actions.shape[1]
    horizon = min(config.horizon, length)
    starts = np.arange(0, length, config.start_every) if config.starts == "every" else np.zeros(1, int)
    times = starts[:, None] + np.arange(horizon)  # [S, H]
    trajectory, window = np.divmod(np.arange(len(data) * len(starts)), len(starts))

    rows = (jnp.asarray(trajectory), jnp.asarray(times[window]))
    transitions, error, before = _predicted(dynamics, data, config, rows)
    inside = np.flatnonzero((times[window] < length).ravel())
    numbers = jnp.repeat(jnp.asarray(trajectory), horizon).reshape(-1, horizon)

    def flat(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])[inside]

    return Examples(*jax.tree.map(flat, (transitions, numbers, error, before)))


@eqx.filter_jit
def _predicted(
    dynamics: Dynamics, data: Trajectories, config: LabelConfig, rows: tuple[Array, Array]
) -> tuple[Transition, Float[Array, "n H"], Float[Array, "n H"]]:
    """Predicted transitions, their errors and those before them: for n trajectories' numbers and H times."""
    length = data.actions.shape[1]

    def predict(row: tuple[Array, Array]) -> tuple[Transition, Array, Array]:
        number, time = row
        # What lies beyond the end is dropped later; until then the last action and state stand there.
        actions = data.actions[number, jnp.minimum(time, length - 1)]
        reached = jnp.minimum(time[0] + jnp.arange(len(time) + 1), length)
        true = jax.tree.map(lambda leaf: leaf[number, reached], data.states)
        first = jax.tree.map(lambda leaf: leaf[0], true)
        obstacles = jax.tree.map(lambda leaf: leaf[number], data.obstacles)
        if config.rollout == "mean":
            states, uncertainty = roll_out(dynamics, obstacles, first, actions)
        elif isinstance(dynamics, Ensemble):
            states, uncertainty = dynamics.roll_out_members(obstacles, first, actions)
        else:
            raise ValueError(
                f"rollout is 'members', but {type(dynamics).__name__} is no ensemble and has none"
            )
        error = rms_distance(states, true)
        before = error[:-1]
        if config.discard == "after first":
            before = jax.lax.cummax(before)
        begin, end = jax.tree.map(lambda leaf: leaf[:-1], states), jax.tree.map(lambda leaf: leaf[1:], states)
        return Transition(begin, actions, end, uncertainty), error[1:], before

    return jax.lax.map(predict, rows, batch_size=1024)
