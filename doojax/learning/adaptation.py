"""Adapt dynamics to that part of new data that resembles the place they come from (FOCUS, thesis 4.3.1).

Dynamics were learned from a source, such as a simulation of another rope without obstacles; the data are from
a target. Where a transition's error is small it is likely that source and target are alike there; so each is
weighted by its own error, and as learning on those lowers the errors of others like them, their weights
grow. What differs for another reason, a rope that hangs on an obstacle, keeps a large error and no weight.

Errors are `doojax.learning.labels.rms_distance`, root mean squares over the rope's N points, metres. The
thesis's text has the squared norm there and its released code the norm of all coordinates, sqrt(N) times
ours: its gamma of 0.08 m for 25 points is 1.6 cm here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int, PyTree

from doojax.learning.buffer import Buffer
from doojax.learning.data import Trajectories
from doojax.learning.fit import FitConfig, Progress, Report, fit, member
from doojax.learning.labels import rms_distance
from doojax.learning.losses import loss_by_step
from doojax.learning.pieces import Pieces, cut, step_errors
from doojax.learning.runs import RunDirectory
from doojax.models.ensemble import Ensemble
from doojax.models.protocols import Dynamics
from doojax.models.rolling import roll_out

AdaptationMethod = Literal["focus", "all_data", "low_initial_error", "hard_initial_error"]
METHODS: tuple[AdaptationMethod, ...] = ("focus", "all_data", "low_initial_error", "hard_initial_error")
BINS = 10  # of weights, from 0 to 1, whose shares are logged for each epoch


def no_report(number: int, epochs: int, metrics: dict[str, np.ndarray]) -> None:
    """Tells nobody."""


@dataclass(frozen=True)
class AdaptationConfig:
    """How dynamics are adapted."""

    method: AdaptationMethod = "focus"
    """focus: weights by the errors of the model as it is; all_data: all weights are one; low_initial_error:
    weights by the errors of the source's model, once and for all; hard_initial_error: the same, with weight
    one below gamma and none above, as the released code does."""
    horizon: int = 5  # steps that are predicted from a true state, in training and for gamma
    quantile: float = 0.97  # of the source's own validation errors, which is gamma
    growth: float = 1e-4
    """Of the sharpness times gamma, for each transition seen. 1e-4 comes to the thesis's last sharpness after
    as many transitions as it had seen: phi of 150 times gamma of 0.08 after 20 epochs of 6,288."""
    counted: Literal["transitions", "steps"] = "transitions"
    """What makes weights sharper: transitions seen, or steps of the optimiser as in the released code, whose
    growth is 0.04 and whose weights change with the batch size."""
    steps: int = 0  # of an epoch; 0: as many as the data make
    fit: FitConfig = field(
        default_factory=lambda: FitConfig(epochs=20, batch_size=32, learning_rate=1e-3, keep="last")
    )

    def __post_init__(self):
        """Refuse settings that weigh nothing."""
        if self.horizon < 1:
            raise ValueError(f"horizon is {self.horizon}, expected at least 1")
        if not 0 < self.quantile < 1:
            raise ValueError(f"quantile is {self.quantile}, expected a number between 0 and 1")
        if not self.growth >= 0:
            raise ValueError(f"growth is {self.growth}, expected at least 0")


class Adapted(NamedTuple):
    """What `adapt` gives."""

    dynamics: Any  # of the same type as before
    seen: int  # transitions, with those seen before: to go on with
    similar: float  # share of the data's transitions whose error is now below gamma


def similarity_weights(
    error: Float[Array, "*b"], gamma: Float[Array, ""] | float, sharpness: Float[Array, ""] | float
) -> Float[Array, "*b"]:
    """How much each transition counts: 1 - sigmoid(sharpness (error - gamma)), equation 4.1.

    No gradient goes through it. An error that is not a number has no weight.

    Args:
        error: m.
        gamma: m, the error of what counts half.
        sharpness: 1/m, phi in the thesis; 0 weighs all alike by a half.
    """
    weight = jax.nn.sigmoid(-sharpness * (stop_gradient(error) - gamma))
    return stop_gradient(jnp.where(jnp.isnan(error), 0.0, weight))


def similarity_threshold(
    dynamics: Dynamics, validation: Trajectories | Sequence[Trajectories], config: AdaptationConfig
) -> float:
    """gamma, m: a quantile of the source model's errors on source data that it was not trained on.

    Errors are those of all steps of pieces as long as those of adaptation, of every member on its own.

    Raises:
        ValueError: for data that cannot be compared, or errors that are all zero.
    """
    pieces = cut(validation, config.horizon)
    members = members_of(dynamics)
    count = len(jax.tree.leaves(eqx.filter(members, eqx.is_array))[0])
    errors = np.stack([step_errors(member(members, index), pieces) for index in range(count)])
    gamma = float(np.nanquantile(errors, config.quantile))
    if not (np.isfinite(gamma) and gamma > 0):
        raise ValueError(f"the {config.quantile:.0%} quantile of the source's errors is {gamma}: no gamma")
    return gamma


def members_of(dynamics: Dynamics) -> Any:
    """An ensemble's networks, or one that is alone, with the leading axis E that `fit` trains."""
    if isinstance(dynamics, Ensemble):
        return dynamics.members
    return jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, dynamics)


class Weighed(eqx.Module):
    """What adaptation learns from: pieces, and how far off the source's model was in them."""

    pieces: Pieces
    initial_error: Float[Array, "n H"]  # m, of the source's model; NaN for steps that are missing


class AdaptationProblem(eqx.Module):
    """Equation 4.1, for `fit`, which tells it how much was seen."""

    train: Buffer  # of `Weighed`
    model: Any  # one network such as those that learn
    gamma: Float[Array, ""]  # m
    sharpness: Float[Array, ""]  # 1/m, of the weights now
    seen: Float[Array, ""]  # transitions (or steps, if these are counted) before this training
    config: AdaptationConfig = eqx.field(static=True)
    steps: int = eqx.field(static=True)  # of an epoch

    def after(self, progress: Progress) -> "AdaptationProblem":
        """Sharper weights: see `doojax.learning.fit.Scheduled`."""
        transitions = progress.examples * self.config.horizon
        count = self.seen + (transitions if self.config.counted == "transitions" else progress.steps)
        sharpness = self.config.growth * count / self.gamma
        return eqx.tree_at(lambda problem: problem.sharpness, self, sharpness)

    def init(self, member: PyTree, *, key: Array) -> Any:
        """The network itself; `fit` is to begin with those of the source."""
        return self.model

    def batches(self, member: PyTree, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Pieces, drawn with replacement."""
        return self.train.drawn(self.steps, batch_size, key=key)

    def loss(self, model: Any, rows: Int[Array, "batch"], member: PyTree) -> Float[Array, ""]:
        """The mean over pieces and steps of weight times squared error, m^2."""
        batch: Weighed = jax.tree.map(lambda leaf: leaf[rows], self.train.items)
        weight, _, loss = jax.vmap(self.weighed, (None, 0))(model, batch)
        return (weight * loss).sum() / batch.pieces.there.sum()

    def validate(self, model: Any, member: PyTree) -> dict[str, Float[Array, ""]]:
        """The loss on all of the data, the share of transitions with an error below gamma, and how many have
        a weight in each of `BINS` equal parts of 0 to 1."""
        weight, error, loss = jax.lax.map(
            lambda one: self.weighed(model, one),
            self.train.items,
            batch_size=min(256, self.train.capacity),
        )
        there = self.train.items.pieces.there & (self.train.weight > 0)[:, None]
        count = there.sum()

        def share(mask: Array) -> Array:
            return (mask & there).sum() / count

        part = jnp.clip((weight * BINS).astype(int), 0, BINS - 1)
        return {
            "loss": jnp.where(there, weight * loss, 0.0).sum() / count,
            "similar": share(error < self.gamma),
            **{f"weights_in_bin_{i}": share(part == i) for i in range(BINS)},
        }

    def weighed(
        self, model: Any, one: Weighed
    ) -> tuple[Float[Array, "H"], Float[Array, "H"], Float[Array, "H"]]:
        """Of one piece the weight of each step, none where it is missing; its error, m; its loss, m^2."""
        states, actions = one.pieces.trajectories.states, one.pieces.trajectories.actions
        first = jax.tree.map(lambda leaf: leaf[0], states)
        predicted, _ = roll_out(model, one.pieces.trajectories.obstacles, first, actions)
        error = rms_distance(predicted, states)[1:]
        weight = self.weights(error, one.initial_error)
        return jnp.where(one.pieces.there, weight, 0.0), error, loss_by_step(predicted, states)

    def weights(self, error: Float[Array, "*b"], initial: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """By the method: of the errors now, or those of the source's model, both m."""
        match self.config.method:
            case "focus":
                return similarity_weights(error, self.gamma, self.sharpness)
            case "low_initial_error":
                return similarity_weights(initial, self.gamma, self.sharpness)
            case "hard_initial_error":
                return jnp.where(initial < self.gamma, 1.0, 0.0)
            case "all_data":
                return jnp.ones_like(error)


def adapt(
    dynamics: Dynamics,
    data: Trajectories | Sequence[Trajectories],
    gamma: float,
    config: AdaptationConfig,
    *,
    seed: int,
    source: Dynamics | None = None,
    seen: int = 0,
    capacity: int | None = None,
    run: RunDirectory | None = None,
    report: Report = no_report,
) -> Adapted:
    """Dynamics that have gone on learning, from target data.

    Args:
        dynamics: to begin with, any; members of an ensemble each learn on their own, by their own errors.
        data: all that is known of the target; lengths may differ from batch to batch.
        gamma: m, see `similarity_threshold`.
        config: how.
        seed: of what is random.
        source: the source's model, by whose errors the methods of initial errors weigh; by default
            ``dynamics``.
        seen: transitions (or steps, if these are counted) that were seen in trainings before.
        capacity: pieces that there is room for: so that more data, up to that many, compile nothing anew, if
            ``config.steps`` is given, too.
        run: where checkpoints and metrics go.
        report: called after each epoch.

    Raises:
        ValueError: for data that are empty, not finite or of other shapes, a gamma that is no length, or
            a method of hard weights where all of them are zero.
    """
    if not (np.isfinite(gamma) and gamma > 0):
        raise ValueError(f"gamma is {gamma}, expected a positive length (m): see similarity_threshold")
    pieces = cut(data, config.horizon)
    initial = step_errors(dynamics if source is None else source, pieces)
    if config.method == "hard_initial_error" and not (initial < gamma).any():
        raise ValueError(
            f"none of {pieces.transitions} transitions has an error of the source's model below gamma = "
            f"{gamma:.3g} m (the least is {np.nanmin(initial):.3g} m): nothing to learn from; raise the "
            "quantile that gamma is, or use the method focus"
        )
    train = Buffer.of(Weighed(pieces, jnp.asarray(initial)), capacity)
    members = members_of(dynamics)
    count = len(jax.tree.leaves(eqx.filter(members, eqx.is_array))[0])
    problem = AdaptationProblem(
        train=train,
        model=member(members, 0),
        gamma=jnp.asarray(gamma, dtype=float),
        sharpness=jnp.zeros((), dtype=float),
        seen=jnp.asarray(seen, dtype=float),
        config=config,
        steps=config.steps or max(1, len(pieces) // config.fit.batch_size),
    )
    fitting = replace(config.fit, members=count)
    models = fit(problem, fitting, seed=seed, run=run, begin=members, report=report)
    adapted: Any = Ensemble(models) if isinstance(dynamics, Ensemble) else member(models, 0)
    errors = step_errors(adapted, pieces)
    steps = problem.steps * config.fit.epochs
    more = steps * config.fit.batch_size * config.horizon if config.counted == "transitions" else steps
    similar = float((errors < gamma).sum() / pieces.transitions)
    return Adapted(adapted, seen + more, similar)
