"""What a summary of results is made of: runs of commands, and the rows that they measured."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

type Tag = str | int | float | bool

HEAD = ("command", "seed", "versions", "device", "date")  # of the latest run, repeated for the whole file


@dataclass(frozen=True)
class Run:
    """One execution of a command that measured something."""

    command: str  # complete: running it again gives the rows again
    seed: int | None  # None where nothing was drawn at random
    versions: Mapping[str, str]
    device: str
    date: str  # UTC, ISO 8601
    inputs: Mapping[str, str] = field(default_factory=dict)  # SHA-256, its beginning, of models, data, scenes
    note: str = ""  # what keeps an old run's command from being run again as it stands


@dataclass(frozen=True)
class Row:
    """One measured figure; `row` makes one."""

    metric: str
    tags: Mapping[str, Tag]
    value: float
    low: float | None  # 95 % interval
    high: float | None
    n: int | None  # sample size
    unit: str  # SI where there is one; "" for a pure number
    run: int = 0  # index into Summary.runs

    @property
    def identity(self) -> str:
        """What a newer measurement of the same thing shares with this one."""
        return f"{self.metric} {json.dumps(dict(self.tags), sort_keys=True)}"


@dataclass(frozen=True)
class Summary:
    """What one summary.json holds."""

    runs: tuple[Run, ...]  # oldest first
    rows: tuple[Row, ...]  # by metric, then tags
