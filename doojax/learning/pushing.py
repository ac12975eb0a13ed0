"""Learn PropNet from trajectories, many networks beside each other, each from data of its own."""

from dataclasses import dataclass, replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from doojax.learning.fit import FitConfig
from doojax.models.propnet import PropNet, PropNetConfig, pushed_along
from doojax.types import PushingState

EPSILON = 1e-6  # m, below which the loss is smooth
STEADY = 1e-5  # m: what moves less in a period rests


class PushingData(eqx.Module):
    """K trajectories of T periods, in the plane; the hand is the last body."""

    places: Float[Array, "K T1 B 2"]  # m
    moves: Float[Array, "K T B 2"]  # m, in each period

    @classmethod
    def of(cls, states: PushingState) -> "PushingData":
        """From states [K, T+1]."""
        places = jnp.asarray(states.bodies())[..., :2]
        return cls(places, places[:, 1:] - places[:, :-1])

    def __len__(self) -> int:
        """K."""
        return len(self.places)


@dataclass(frozen=True)
class PushingPreset:
    """A network and how it is trained."""

    network: PropNetConfig
    fit: FitConfig
    window: int  # periods that a prediction runs on, in training
    steps: int  # of an epoch


class PropNetProblem(eqx.Module):
    """A `doojax.learning.fit.Problem`: multi-step prediction.

    A member is (first, count): which of the training trajectories are its own. Windows are drawn uniformly
    from them, so that all members take equally many steps, however many trajectories they have.
    """

    train: PushingData
    validation: PushingData
    network: PropNetConfig = eqx.field(static=True)
    window: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    def init(self, member: tuple[Int[Array, ""], Int[Array, ""]], *, key: Array) -> PropNet:
        """A fresh network."""
        return PropNet(self.network, key=key)

    @property
    def starts(self) -> int:
        """Of windows in a trajectory."""
        return self.train.moves.shape[1] - self.window + 1

    def batches(
        self, member: tuple[Int[Array, ""], Int[Array, ""]], batch_size: int, *, key: Array
    ) -> Int[Array, "steps batch"]:
        """Numbers of windows: trajectory times windows of one, plus the window."""
        first, count = member
        own = jax.random.randint(key, (self.steps, batch_size), 0, count * self.starts)
        return first * self.starts + own

    def loss(self, model: PropNet, rows: Int[Array, "batch"], member: object) -> Float[Array, ""]:
        """Mean distance (m) between true and predicted motions, over batch, window and bodies."""
        trajectory, start = jnp.divmod(rows, self.starts)

        def one(trajectory: Array, start: Array) -> Array:
            places = jax.lax.dynamic_slice_in_dim(self.train.places[trajectory], start, self.window)
            all_moves = self.train.moves[trajectory]
            moves = jax.lax.dynamic_slice_in_dim(all_moves, start, self.window)
            before = jnp.where(start > 0, all_moves[jnp.maximum(start - 1, 0)], 0.0)
            _, found = pushed_along(model, places[0], before, places[:, -1], moves[:, -1])
            return jnp.sqrt(((found - moves[:, :-1]) ** 2).sum(-1) + EPSILON**2).mean()

        return jax.vmap(one)(trajectory, start).mean()

    def validate(self, model: PropNet, member: object) -> dict[str, Float[Array, ""]]:
        """The mean position error (m) of whole trajectories."""
        return {"loss": position_errors(model, self.validation).mean()}


def predicted(model: PropNet, data: PushingData) -> tuple[Float[Array, "K T N 2"], Float[Array, "K T N 2"]]:
    """Places after each period, and motions, from the first state and the hand's way alone."""

    def one(places: Array, moves: Array) -> tuple[Array, Array]:
        return pushed_along(model, places[0], jnp.zeros_like(places[0]), places[:-1, -1], moves[:, -1])

    return jax.vmap(one)(data.places, data.moves)


def position_errors(model: PropNet, data: PushingData) -> Float[Array, "K T N"]:
    """Distances (m) between predicted and true places; of the bodies, not of the hand, whose are given."""
    return _distance(predicted(model, data)[0], data.places[:, 1:, :-1])


@eqx.filter_jit
def measured(model: PropNet, data: PushingData) -> dict[str, Float[Array, ""]]:
    """The thesis's figures of whole trajectories.

    Returns:
        ``position_error`` and its 95 % quantile (m) over trajectories, periods and bodies; ``penetration``
        (m), by how much the bodies of a state lie in each other in all, in the mean; and ``ghostly`` (m), how
        far a body moves in a period in which it touches nothing and is not near anything, in the mean.
    """
    places, moves = predicted(model, data)
    errors = _distance(places, data.places[:, 1:, :-1])
    everything = jnp.concatenate([places, data.places[:, 1:, -1:]], axis=2)
    gaps = _distance(everything[:, :, :, None], everything[:, :, None])
    count, width = gaps.shape[-1], 2 * model.config.radius
    deep = jnp.where(jnp.triu(jnp.ones((count, count), dtype=bool), 1), jnp.maximum(width - gaps, 0), 0.0)
    alone = (jnp.where(jnp.eye(count, dtype=bool), jnp.inf, gaps).min(-1) > model.config.reach)[:, :, :-1]
    way = _distance(moves, 0.0)
    return {
        "position_error": errors.mean(),
        "position_error_95": jnp.quantile(errors, 0.95),
        "penetration": deep.sum((2, 3)).mean(),
        "ghostly": jnp.where(alone, way, 0.0).sum() / jnp.maximum(alone.sum(), 1),
    }


def _distance(first: Array, second: Array | float) -> Array:
    return jnp.sqrt(((first - second) ** 2).sum(-1))


def stay_error(data: PushingData) -> float:
    """The position error (m) of the guess that no body ever moves: what any network has to beat."""
    return float(np.asarray(_distance(data.places[:, 1:, :-1], data.places[:, :1, :-1])).mean())


PushingPresetName = Literal["quick", "thesis_network", "thesis"]


def pushing_preset(name: PushingPresetName, bodies: int, period: float) -> PushingPreset:
    """`thesis`: its sizes, on whole trajectories; `quick`: narrow, with few joints, on windows.

    `thesis_network` has the widths and passes of the thesis's, and learns as the quick one does.
    """
    if name == "thesis":
        network = PropNetConfig(bodies, period)
        fit = FitConfig(epochs=250, batch_size=32, schedule="constant")
        return PushingPreset(network, fit, window=49, steps=500)
    network = PropNetConfig(bodies, period, joints=24, position_unit=0.05, motion_unit=0.003)
    if name == "quick":
        network = replace(network, particle=32, relation=32, effect=32, passes=2)
    fit = FitConfig(epochs=25, batch_size=16, learning_rate=2e-3)
    return PushingPreset(network, fit, window=10, steps=100)
