"""Adapt a source rope's dynamics to the rope that is executed, and learn where they hold (thesis 4.3)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from doojax.experiments.online.experience import executed
from doojax.experiments.online.learners import Lesson
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.setting import Method
from doojax.keys import generator
from doojax.learning.adaptation import AdaptationConfig, AdaptationMethod, adapt
from doojax.learning.checkpoints import Header, load_model, save_model
from doojax.learning.data import Trajectories
from doojax.learning.deviation import DeviationConfig, calibrated, deviation_examples, fit_deviation
from doojax.learning.fit import FitConfig
from doojax.learning.presets import deviation_preset
from doojax.learning.provenance import SAW
from doojax.models import Always
from doojax.models.deviation import DeviationEstimator
from doojax.planning.recovery import RandomRecovery
from doojax.tasks.base import Task

FILES = {"dynamics": "dynamics.eqx", "deviation": "deviation.eqx"}
EVERY = 5  # one trajectory in so many chooses the estimator's epoch, and nothing is learned from it


@dataclass(frozen=True)
class FocusSettings:
    """How dynamics and the estimator of their deviation learn online."""

    steps: int = 100  # of each epoch of the adaptation
    epochs: int = 2  # of the adaptation
    batch_size: int = 32  # pieces
    learning_rate: float = 1e-3
    growth: float = 1e-4  # see `AdaptationConfig.growth`
    deviation_steps: int = 100  # of each epoch of the estimator
    deviation_epochs: int = 3
    capacity: int = 16_384  # pieces, and examples; more than that are refused

    def __post_init__(self):
        """Refuse what learns nothing."""
        for name in ("steps", "epochs", "batch_size", "deviation_steps", "deviation_epochs", "capacity"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")

    def adaptation(self, method: AdaptationMethod) -> AdaptationConfig:
        """Of dynamics, by a method."""
        fit = FitConfig(
            self.epochs,
            self.batch_size,
            learning_rate=self.learning_rate,
            schedule="constant",
            keep="last",
        )
        return AdaptationConfig(method=method, growth=self.growth, steps=self.steps, fit=fit)


def divided[T](trajectories: Sequence[T]) -> tuple[Sequence[T], Sequence[T], Sequence[T]]:
    """What an estimator learns from, what chooses its epoch, and what calibrates it.

    One in `EVERY` chooses, and as many calibrate once there are two of them. While there are fewer than
    `EVERY`, all are learned from and choose.
    """
    if len(trajectories) < EVERY:
        return trajectories, trajectories, ()
    spare = trajectories[1::EVERY]
    spare = spare if len(spare) > 1 else ()
    kept = (0, 1) if spare else (0,)
    learned = [one for number, one in enumerate(trajectories) if number % EVERY not in kept]
    return learned, trajectories[::EVERY], spare


class Known(NamedTuple):
    """What is known at some iteration."""

    dynamics: Any
    deviation: DeviationEstimator | None  # None: nothing was tried yet, and all is accepted
    trajectories: tuple[Trajectories, ...]  # all that was executed
    seen: int  # transitions, in all adaptations


@dataclass(frozen=True, eq=False)
class FocusLearner:
    """Dynamics that adapt, weighing data by a method, and an estimator of how far off they are.

    Its labels are made anew of all trajectories whenever the dynamics have changed.
    """

    name: str
    task: Task
    source: Any  # dynamics
    config: dict[str, Any]  # what these are built from
    gamma: float  # m, the error of what counts half
    limit: float  # m, d_max
    weighing: AdaptationMethod
    estimated: bool = True  # false: no estimator, and all is accepted
    settings: FocusSettings = field(default_factory=FocusSettings)
    stationary: bool = False

    @cached_property
    def _deviation(self) -> DeviationConfig:
        network = deviation_preset("quick", self.task).network
        settings = self.settings
        fit = FitConfig(settings.deviation_epochs, 128)
        return DeviationConfig(network, steps=settings.deviation_steps, fit=fit)

    def fresh(self, seed: int) -> Known:
        """The source's dynamics."""
        return Known(self.source, None, (), 0)

    def method(self, known: Known) -> Method:
        """The estimator judges, once there is one; where it lets nothing pass, a random action is tried."""
        judge = Always() if known.deviation is None else known.deviation
        return Method(self.name, known.dynamics, judge, RandomRecovery(), error_threshold_m=self.limit)

    def taken(self, known: Known, records: Sequence[TrialRecord], seed: int, iteration: int) -> Lesson:
        """Keep what was executed."""
        fresh = tuple(executed(records))
        told = () if fresh else ("nothing was executed, so there is nothing to learn from",)
        figures = {"new_transitions": sum(one.actions.shape[1] for one in fresh)}
        return Lesson(known._replace(trajectories=(*known.trajectories, *fresh)), figures, told)

    def learned(self, known: Known, seed: int, iteration: int) -> Lesson:
        """Adapt on all that was executed, label all of it anew, and go on with the estimator."""
        nothing = {"transitions": 0, "similar": 0.0, "deviation_m": 0.0, "estimate_off_m": 0.0}
        if not known.trajectories:
            return Lesson(known, nothing, ("there are no data yet: the dynamics stay the source's",))
        numbers = generator(seed, "online focus", self.task.name, str(iteration)).integers(2**62, size=2)
        adapted = adapt(
            known.dynamics,
            known.trajectories,
            self.gamma,
            self.settings.adaptation(self.weighing),
            seed=int(numbers[0]),
            source=self.source,
            seen=known.seen,
            capacity=self.settings.capacity,
        )
        told = []
        if adapted.similar == 0.0:
            told.append(f"no transition has an error below gamma = {self.gamma:.3g} m: none is similar")
        deviation, examples, off = self._estimated(known, adapted.dynamics, int(numbers[1]))
        figures = {
            "transitions": sum(one.actions.shape[1] for one in known.trajectories),
            "similar": adapted.similar,
            "deviation_m": float(np.median(np.asarray(examples.deviation))),
            "estimate_off_m": off,
        }
        new = Known(adapted.dynamics, deviation, known.trajectories, adapted.seen)
        return Lesson(new, figures, tuple(told))

    def _estimated(
        self, known: Known, dynamics: Any, seed: int
    ) -> tuple[DeviationEstimator | None, Any, float]:
        """The estimator that has gone on, the examples it learned from, its mean error (m) on others."""
        learned, held, spare = divided(known.trajectories)
        config = self._deviation
        train, validation = (
            deviation_examples(dynamics, list(some), horizon=config.horizon) for some in (learned, held)
        )
        if not self.estimated:
            return None, train, 0.0
        measured: dict[str, np.ndarray] = {}
        fitted = fit_deviation(
            train,
            validation,
            config,
            seed=seed,
            begin=known.deviation,
            capacity=self.settings.capacity,
            report=lambda number, epochs, metrics: measured.update(metrics),
        )
        if spare:
            examples = deviation_examples(dynamics, list(spare), horizon=config.horizon)
            fitted, _ = calibrated(fitted, examples)
        return fitted.limited(self.limit), train, float(measured["validation_error_m"][0])

    def save(self, folder: Path, known: Known, saw: list[dict[str, Any]]) -> None:
        """Write dynamics and, where there is one, the estimator."""
        about = {"threshold_m": self.limit, SAW: saw, "seen_transitions": known.seen}
        header = Header("dynamics", self.task.name, self.config, about)
        save_model(folder / FILES["dynamics"], header, known.dynamics)
        if known.deviation is not None:
            network = asdict(self._deviation.network)
            header = Header("deviation", self.task.name, network, about)
            save_model(folder / FILES["deviation"], header, known.deviation)

    def restored(self, folder: Path, known: Known) -> Known:
        """Read them."""
        dynamics, header = load_model(folder / FILES["dynamics"], task=self.task.name, kind="dynamics")
        file, deviation = folder / FILES["deviation"], None
        if file.exists():
            deviation, _ = load_model(file, task=self.task.name, kind="deviation")
        return Known(dynamics, deviation, known.trajectories, int(header.about["seen_transitions"]))
