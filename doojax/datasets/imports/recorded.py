"""What a folder of another library holds, in doojax's words."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from doojax.datasets.manifest import Field
from doojax.reading import checked


@dataclass(frozen=True)
class ExportedField(Field):
    """A field of the data set that was exported, with the names that its numbers have there."""

    coordinates: tuple[str, ...] = ()

    @property
    def plain(self) -> Field:
        """The field of the data set."""
        return Field(self.shape, self.dtype, self.unit, self.description, self.may_be_missing)


@dataclass(frozen=True)
class About:
    """What `doojax.datasets.exports.Episodes.about` wrote beside the data."""

    config: dict[str, Any]
    versions: dict[str, str]
    fields: dict[str, ExportedField]
    control_period_s: float
    left_out_without_values: int = 0
    left_out: tuple[str, ...] = field(default=())  # fields that only a replay needs


class Recorded(NamedTuple):
    """K episodes of T actions."""

    arrays: dict[str, Shaped[np.ndarray, "K ..."]]  # by field of a data set, in the order of its trajectories
    about: About | None  # None: doojax did not make them
    splits: list[str]  # of each episode, where doojax made them


def about_of(content: object, file: Path) -> About:
    """What doojax wrote beside the data that it exported.

    Raises:
        ValueError: it was changed, or an older doojax wrote it.
    """
    try:
        return checked(content, About)
    except ValueError as error:
        raise ValueError(f"{file} does not say of doojax's export what it should: {error}") from error


def one_length(lengths: dict[int, int], source: Path) -> int:
    """The steps that all episodes have.

    Args:
        lengths: by number of the episode.
        source: of what, for the message.

    Raises:
        ValueError: they differ, or there are none.
    """
    found = sorted(set(lengths.values()))
    if not found:
        raise ValueError(f"{source} has no episodes")
    if len(found) > 1:
        first = {length: number for number, length in reversed(lengths.items())}
        example = f"episode {first[found[0]]} has {found[0]}, episode {first[found[-1]]} has {found[-1]}"
        raise ValueError(f"{source} has episodes of {len(found)} lengths ({example}): cut them to one length")
    return found[0]


def once(name: str, values: Shaped[np.ndarray, "K T ..."], source: Path) -> Shaped[np.ndarray, "K ..."]:
    """What is the same at all steps of an episode.

    Raises:
        ValueError: it is not.
    """
    if (values != values[:, :1]).any():
        number = int(np.argmax((values != values[:, :1]).reshape(len(values), -1).any(1)))
        raise ValueError(f"{source}: {name} changes within episode {number}, but obstacles stand still")
    return values[:, 0]
