"""Learn where to trust fixed dynamics, from nothing, trial by trial (thesis section 3.4.2)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from doojax.actions import nothing_of
from doojax.augmentation import setting_of, usual
from doojax.experiments.online.experience import Enrichment, enriched, executed, judged_by_outcome
from doojax.experiments.online.learners import Lesson
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.setting import Method
from doojax.keys import generator, stream
from doojax.learning.buffer import Buffer
from doojax.learning.buffered import BufferedClassifier, Labelled
from doojax.learning.checkpoints import MODEL, Header, load_model, save_model
from doojax.learning.fit import FitConfig, fit, member
from doojax.learning.labels import LabelConfig
from doojax.learning.presets import classifier_preset
from doojax.learning.provenance import SAW
from doojax.models.classifier import ClassifierConfig, DistanceClassifier
from doojax.models.protocols import Dynamics
from doojax.planning.recovery import RandomRecovery
from doojax.simulation.scenes import obstacles_at, parked_poses
from doojax.tasks.base import Task
from doojax.types import Transition


@dataclass(frozen=True)
class ReliabilitySettings:
    """How a classifier learns online."""

    steps: int = 200  # of the optimiser, in each iteration
    batch_size: int = 64
    learning_rate: float = 1e-3  # of Adam, which begins anew in each iteration
    capacity: int = 16_384  # examples kept; then the oldest go
    attempts: int = 512  # augmentations, or noisy copies, tried of each trial's examples
    start_every: int = 2  # states of a trial, from which predictions begin that are labelled
    horizon: int = 10  # steps that they go on for

    def __post_init__(self):
        """Refuse what learns nothing."""
        for name in ("steps", "batch_size", "capacity", "attempts", "start_every", "horizon"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")

    @property
    def labels(self) -> LabelConfig:
        """Which predictions are labelled."""
        return LabelConfig(start_every=self.start_every, horizon=self.horizon)

    @property
    def fit(self) -> FitConfig:
        """How an iteration trains."""
        return FitConfig(1, self.batch_size, learning_rate=self.learning_rate, schedule="constant")


class Known(NamedTuple):
    """What is known at some iteration."""

    models: Any  # a classifier with a leading axis of one, as `fit` has it
    buffer: Buffer  # of `Labelled`


@dataclass(frozen=True, eq=False)
class ReliabilityLearner:
    """An untrained classifier that learns from its trials; the dynamics stay as they are."""

    name: str
    task: Task
    dynamics: Dynamics
    threshold: float  # m, of the error below which a prediction is right
    longest: int  # actions of a trial
    enrichment: Enrichment = "none"
    settings: ReliabilitySettings = ReliabilitySettings()
    stationary: bool = False

    @cached_property
    def network(self) -> ClassifierConfig:
        """What the classifier is built from: the task's quick preset."""
        return classifier_preset("quick", self.task).network

    def fresh(self, seed: int) -> Known:
        """A random classifier, and no example."""
        key = stream(seed, "online classifier", self.task.name)
        model = DistanceClassifier(self.network, key=key)
        models = jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, model)
        return Known(models, Buffer.like(self._blank, self.settings.capacity))

    def method(self, known: Known) -> Method:
        """The classifier judges; where it lets nothing pass, a random action is tried."""
        return Method(
            self.name,
            self.dynamics,
            member(known.models, 0),
            RandomRecovery(),
            error_threshold_m=self.threshold,
        )

    def taken(self, known: Known, records: Sequence[TrialRecord], seed: int, iteration: int) -> Lesson:
        """Label what was executed, and enrich it."""
        buffer, made = known.buffer, 0
        right = wrong = 0
        trajectories = executed(records)
        told = [] if trajectories else ["nothing was executed, so there is nothing to learn from"]
        for number, trajectory in enumerate(trajectories):
            labelled, keep = judged_by_outcome(
                self.dynamics, trajectory, self.threshold, self.settings.labels, self.longest
            )
            if not keep.any():
                continue
            of = np.asarray(labelled.right)[keep]
            right, wrong = right + int(of.sum()), wrong + int((~of).sum())
            buffer = buffer.added(labelled, keep=jnp.asarray(keep))
            if self.enrichment != "none":
                more, valid = self._enriched(labelled, keep, seed, iteration, number)
                buffer, made = buffer.added(more, keep=jnp.asarray(valid)), made + int(valid.sum())
        if trajectories and not right + wrong:
            told.append("no prediction could be compared with what was executed")
        if trajectories and right + wrong and self.enrichment != "none" and not made:
            told.append(f"no {self.enrichment} of {right + wrong} examples was valid")
        figures = {"new_right": right, "new_wrong": wrong, "new_made": made}
        return Lesson(Known(known.models, buffer), figures, tuple(told))

    def learned(self, known: Known, seed: int, iteration: int) -> Lesson:
        """Go on with the classifier on all that is in the buffer."""
        weight, right = np.asarray(known.buffer.weight), np.asarray(known.buffer.items.right)
        rights, wrongs = int(weight[right].sum()), int(weight[~right].sum())
        figures = {"examples": rights + wrongs, "wrong_share": wrongs / max(rights + wrongs, 1)}
        if not rights + wrongs:
            told = ("there are no examples yet: the classifier stays untrained",)
            return Lesson(known, figures | {"loss": 0.0, "balanced_accuracy": 0.0}, told)
        told = ()
        if not rights or not wrongs:
            only, none = ("right", "wrong") if rights else ("wrong", "right")
            told = (f"all {rights + wrongs} examples were {only}, none {none}: it learns that all are",)
        problem = BufferedClassifier(known.buffer, self.settings.steps, DistanceClassifier, self.network)
        measured: dict[str, np.ndarray] = {}
        models = fit(
            problem,
            self.settings.fit,
            seed=int(generator(seed, "online fit", self.task.name, str(iteration)).integers(2**62)),
            begin=known.models,
            report=lambda number, epochs, metrics: measured.update(metrics),
        )
        for name in ("loss", "balanced_accuracy"):
            figures[name] = float(measured[f"validation_{name}"][0])
        return Lesson(Known(models, known.buffer), figures, told)

    def save(self, folder: Path, known: Known, saw: list[dict[str, Any]]) -> None:
        """Write the classifier."""
        about = {"threshold_m": self.threshold, "labels": asdict(self.settings.labels), SAW: saw}
        header = Header("classifier", self.task.name, asdict(self.network), about)
        save_model(folder / MODEL, header, member(known.models, 0))

    def restored(self, folder: Path, known: Known) -> Known:
        """Read it."""
        model, _ = load_model(folder / MODEL, task=self.task.name, kind="classifier")
        models = jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, model)
        return Known(models, known.buffer)

    @cached_property
    def _blank(self) -> Labelled:
        """One example's shapes, with a leading axis."""
        state, scene = self.task.blank, self.task.scene
        transition = Transition(state, nothing_of(self.task.actions), state, jnp.zeros(()))
        obstacles = obstacles_at(scene, *parked_poses(len(scene.obstacles)))
        one = Labelled(transition, obstacles, jnp.zeros((), dtype=bool))
        return jax.tree.map(lambda leaf: leaf[None], one)

    @cached_property
    def _augmentation(self) -> tuple[Any, Any]:
        bounds, projection = usual(self.task)
        return setting_of(self.task, bounds), projection

    def _enriched(
        self, labelled: Labelled, keep: np.ndarray, seed: int, iteration: int, number: int
    ) -> tuple[Labelled, np.ndarray]:
        names = ("online", self.enrichment, self.task.name, str(iteration), str(number))
        setting, projection = self._augmentation
        attempts = self.settings.attempts
        return enriched(self.enrichment, stream(seed, *names), labelled, keep, setting, projection, attempts)
