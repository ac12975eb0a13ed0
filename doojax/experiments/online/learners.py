"""Who learns online: what a learner is asked for, and those that learn nothing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.setting import Method


class Lesson(NamedTuple):
    """What an iteration taught."""

    known: Any  # what the learner knows now
    figures: Mapping[str, float]  # of the same names in every iteration
    told: tuple[str, ...] = ()  # what a user ought to hear


@runtime_checkable
class Learner(Protocol):
    """Learns from its own trials; what it knows is data, so that seeds and resumed runs share nothing."""

    @property
    def name(self) -> str:
        """The method's."""
        ...

    @property
    def stationary(self) -> bool:
        """Does it learn nothing? Then trying once is enough."""
        ...

    def fresh(self, seed: int) -> Any:
        """What it knows before anything was tried."""
        ...

    def method(self, known: Any) -> Method:
        """With what it plans."""
        ...

    def taken(self, known: Any, records: Sequence[TrialRecord], seed: int, iteration: int) -> Lesson:
        """What it knows with an iteration's data added, nothing learned from them yet."""
        ...

    def learned(self, known: Any, seed: int, iteration: int) -> Lesson:
        """What it knows when it has trained on all data so far."""
        ...

    def save(self, folder: Path, known: Any, saw: list[dict[str, Any]]) -> None:
        """Write its models; ``saw`` is what they learned from, see `doojax.learning.provenance`."""
        ...

    def restored(self, folder: Path, known: Any) -> Any:
        """What it knows with the models that `save` wrote in place of its own."""
        ...


@dataclass(frozen=True, eq=False)
class Stationary:
    """A method that learns nothing."""

    planned: Method
    stationary: bool = True

    @property
    def name(self) -> str:
        """The method's."""
        return self.planned.name

    def fresh(self, seed: int) -> None:
        """Nothing."""

    def method(self, known: None) -> Method:
        """Always the same."""
        return self.planned

    def taken(self, known: None, records: Sequence[TrialRecord], seed: int, iteration: int) -> Lesson:
        """Nothing."""
        return Lesson(None, {})

    def learned(self, known: None, seed: int, iteration: int) -> Lesson:
        """Nothing."""
        return Lesson(None, {})

    def save(self, folder: Path, known: None, saw: list[dict[str, Any]]) -> None:
        """Nothing."""

    def restored(self, folder: Path, known: None) -> None:
        """Nothing."""
