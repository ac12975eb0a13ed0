"""Learning how far off predictions will be: the model deviation estimator (thesis 4.3.2.2).

Examples begin at every state of every trajectory; their labels are made anew whenever the dynamics change.
The thesis's network sees 44^3 voxels; this one sees distances, as `doojax.models.classifier` does.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from doojax.learning.adaptation import no_report
from doojax.learning.buffer import Buffer
from doojax.learning.calibration import conformal_factor, fit_power
from doojax.learning.data import Trajectories
from doojax.learning.fit import FitConfig, Report, fit, member
from doojax.learning.labels import LabelConfig, label
from doojax.learning.pieces import chunked, cut
from doojax.learning.runs import RunDirectory
from doojax.models.classifier import ClassifierConfig
from doojax.models.deviation import DeviationEstimator
from doojax.models.pouring import PouringJudgeConfig
from doojax.models.protocols import Dynamics
from doojax.types import Obstacles, Transition


class DeviationExamples(eqx.Module):
    """n predicted transitions with what became of them."""

    transition: Transition  # [n]
    obstacles: Obstacles  # [n], around each
    deviation: Float[Array, "n"]  # of the prediction from what happened, m
    trajectory: Int[Array, "n"]  # that each is from

    def __len__(self) -> int:
        """n."""
        return self.deviation.shape[0]


@dataclass(frozen=True)
class DeviationConfig:
    """How a deviation estimator is trained."""

    network: ClassifierConfig | PouringJudgeConfig
    horizon: int = 2  # steps that are predicted from each state: the first from a true one
    bias: float = 50.0
    """k_h, 1/m: how soon large deviations need not be predicted well. The thesis's 10 is for an error that is
    sqrt(N) times ours, N = 25."""
    steps: int = 0  # of an epoch; 0: as many as the data make
    fit: FitConfig = field(default_factory=lambda: FitConfig(epochs=10, batch_size=128))

    def __post_init__(self):
        """Refuse what cannot be trained."""
        if self.horizon < 1:
            raise ValueError(f"horizon is {self.horizon}, expected at least 1")
        if not self.bias >= 0:
            raise ValueError(f"bias is {self.bias}, expected at least 0")


def deviation_examples(
    dynamics: Dynamics,
    data: Trajectories | Sequence[Trajectories],
    *,
    horizon: int,
    kept_below: float = np.inf,
) -> DeviationExamples:
    """Predicted transitions from every state of some trajectories, and how far off they were.

    Args:
        dynamics: whose predictions; when they change, so do all examples.
        data: trajectories, whose lengths may differ from batch to batch.
        horizon: steps that are predicted from each state.
        kept_below: m; what begins with a larger deviation is left out, as no plan goes on from there.

    Raises:
        ValueError: as `doojax.learning.pieces.cut`.
    """
    pieces = cut(data, horizon, every=1)
    config = LabelConfig(starts="first", horizon=horizon)

    def labelled(model: Dynamics, some: Trajectories) -> Any:
        found = label(model, some, config)
        apart = (found.transition, found.error, found.error_before)
        return jax.tree.map(lambda leaf: leaf.reshape(len(some), horizon, *leaf.shape[1:]), apart)

    transition, error, before = chunked(labelled, dynamics, pieces.trajectories)
    piece, step = np.nonzero(np.asarray(pieces.there) & (before < kept_below))
    scenes = jax.tree.map(np.asarray, pieces.trajectories.obstacles)
    take = lambda tree: jax.tree.map(lambda leaf: jnp.asarray(leaf[piece, step]), tree)  # noqa: E731
    return DeviationExamples(
        transition=take(transition),
        obstacles=jax.tree.map(lambda leaf: jnp.asarray(leaf[piece]), scenes),
        deviation=take(error),
        trajectory=jnp.asarray(np.asarray(pieces.origin)[piece]),
    )


def biased_loss(
    predicted: Float[Array, "*b"], true: Float[Array, "*b"], bias: Float[Array, ""] | float
) -> Float[Array, "*b"]:
    """(predicted - true)^2 exp(-bias true), m^2, equation 4.2: large deviations matter less.

    Args:
        predicted: m.
        true: m.
        bias: k_h, 1/m.
    """
    return (predicted - true) ** 2 * jnp.exp(-bias * true)


class DeviationProblem(eqx.Module):
    """Equation 4.2, for `fit`."""

    train: Buffer  # of `DeviationExamples`
    validation: Buffer
    begin: DeviationEstimator | None
    config: DeviationConfig = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    def init(self, member: PyTree, *, key: Array) -> DeviationEstimator:
        """A fresh network, in units of the middle deviation; or the one to begin with."""
        if self.begin is not None:
            return self.begin
        fresh = DeviationEstimator(self.config.network, key=key)
        deviations = self.train.items.deviation
        known = jnp.where(self.train.weight > 0, deviations, jnp.nan)
        return eqx.tree_at(lambda model: model.scale, fresh, jnp.maximum(jnp.nanmedian(known), 1e-6))

    def batches(self, member: PyTree, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Examples, drawn with replacement."""
        return self.train.drawn(self.steps, batch_size, key=key)

    def loss(self, model: DeviationEstimator, rows: Int[Array, "batch"], member: PyTree) -> Float[Array, ""]:
        """The mean of `biased_loss`, in units of the network's own scale."""
        batch = jax.tree.map(lambda leaf: leaf[rows], self.train.items)
        return self.losses(model, batch)[0].mean()

    def validate(self, model: DeviationEstimator, member: PyTree) -> dict[str, Float[Array, ""]]:
        """The loss, and the mean absolute error (m)."""
        loss, gap = jax.lax.map(
            lambda one: jax.tree.map(
                lambda leaf: leaf[0], self.losses(model, jax.tree.map(lambda leaf: leaf[None], one))
            ),
            self.validation.items,
            batch_size=min(512, self.validation.capacity),
        )
        weight = self.validation.weight / self.validation.weight.sum()
        return {"loss": (weight * loss).sum(), "error_m": (weight * gap).sum()}

    def losses(
        self, model: DeviationEstimator, batch: DeviationExamples
    ) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
        """`biased_loss` over the squared scale, and absolute errors (m)."""
        predicted = jax.vmap(model.uncalibrated)(batch.obstacles, batch.transition)
        loss = biased_loss(predicted, batch.deviation, self.config.bias)
        return loss / jax.lax.stop_gradient(model.scale) ** 2, jnp.abs(predicted - batch.deviation)


def fit_deviation(
    train: DeviationExamples,
    validation: DeviationExamples,
    config: DeviationConfig,
    *,
    seed: int,
    begin: DeviationEstimator | None = None,
    capacity: int | None = None,
    run: RunDirectory | None = None,
    report: Report = no_report,
) -> DeviationEstimator:
    """A deviation estimator that is not calibrated yet; its limit is that of ``begin``, or 1 m.

    Args:
        train: what it learns from.
        validation: what chooses the epoch, from other trajectories.
        config: how.
        seed: of what is random.
        begin: one to go on with.
        capacity: examples that there is room for, of either: so that more of them compile nothing anew, if
            ``config.steps`` is given, too.
        run: where checkpoints and metrics go.
        report: called after each epoch.

    Raises:
        ValueError: for no examples, more than there is room for, or a ``begin`` of other sizes.
    """
    for name, examples in (("training", train), ("validation", validation)):
        if not len(examples):
            raise ValueError(f"there are no {name} examples: collect more data, or keep larger deviations")
    if begin is not None:  # uncalibrated: the network itself learns what the calibration had made good
        begin = eqx.tree_at(lambda model: (model.power, model.shift), begin, (jnp.ones(()), jnp.zeros(())))
    problem = DeviationProblem(
        train=Buffer.of(train, capacity),
        validation=Buffer.of(validation, capacity),
        begin=begin,
        config=config,
        steps=config.steps or max(1, len(train) // config.fit.batch_size),
    )
    first = None if begin is None else jax.tree.map(lambda x: x[None] if eqx.is_array(x) else x, begin)
    fitting = replace(config.fit, members=1)
    return member(fit(problem, fitting, seed=seed, run=run, begin=first, report=report), 0)


def deviations(model: DeviationEstimator, examples: DeviationExamples) -> Float[np.ndarray, "n"]:
    """What a model says of examples, calibrated, m."""
    return chunked(_deviations, model, (examples.obstacles, examples.transition))


@eqx.filter_jit
def _deviations(model: DeviationEstimator, batch: tuple[Obstacles, Transition]) -> Float[Array, "n"]:
    return jax.vmap(model.deviation)(*batch)


def calibrated(
    model: DeviationEstimator, examples: DeviationExamples, alphas: Sequence[float] = (0.05, 0.1)
) -> tuple[DeviationEstimator, dict[float, float]]:
    """A model whose deviations mean what they say, and factors from them to upper bounds, by rate.

    Every other trajectory fits the two numbers of the calibration, the rest the bounds, so that neither was
    chosen by what it is judged by.

    Args:
        model: as `fit_deviation` gave it.
        examples: of trajectories that it has not seen.
        alphas: rates at which a bound may be exceeded.

    Raises:
        ValueError: for fewer than two trajectories.
    """
    numbers, index = np.unique(np.asarray(examples.trajectory), return_inverse=True)
    if len(numbers) < 2:
        raise ValueError(f"there are {len(numbers)} trajectories to calibrate with, expected at least 2")
    first = index % 2 == 0
    plain = eqx.tree_at(lambda one: (one.power, one.shift), model, (jnp.ones(()), jnp.zeros(())))
    raw, true = deviations(plain, examples), np.asarray(examples.deviation)
    power, shift = fit_power(raw[first], true[first])
    model = eqx.tree_at(
        lambda one: (one.power, one.shift), model, (jnp.asarray(power, float), jnp.asarray(shift, float))
    )
    found = deviations(model, examples)
    return model, {
        alpha: conformal_factor(found[~first], true[~first], alpha, index[~first]) for alpha in alphas
    }
