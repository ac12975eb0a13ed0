"""Numbers by which the trajectories of a data set are filtered and sorted."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from doojax.datasets import Dataset
from doojax.viewer.episodes import points_field

REDUCTIONS = {"greatest": np.nanmax, "least": np.nanmin, "mean": np.nanmean}
UNITS = {"stretch": ("%", 100.0), "clearance": ("mm", 1000.0)}  # for the eye: unit, factor to it


class Column(NamedTuple):
    """How a column is made of a stored field."""

    field: str
    reduction: str  # "" for a field of one number per trajectory
    factor: float


class Columns:
    """One number for each trajectory, from any stored field that has one number per state at most.

    A column is read when it is first asked for, a shard at a time.
    """

    def __init__(self, dataset: Dataset, on_problem: Callable[[str], None]):
        """Columns of a data set; ``on_problem`` is told of shards that cannot be read."""
        self._dataset = dataset
        self._on_problem = on_problem
        self._found: dict[str, np.ndarray] = {}
        self._columns: dict[str, Column] = {}
        for name, field in dataset.fields.items():
            label, factor = shown_as(name)
            if name == "faults":
                self._columns["any fault"] = Column(name, "any", 1.0)
            elif name in curves(dataset):
                for reduction in REDUCTIONS:
                    self._columns[f"{reduction} {label}"] = Column(name, reduction, factor)
            elif field.shape == ():
                self._columns[label] = Column(name, "", factor)

    @property
    def names(self) -> tuple[str, ...]:
        """What the columns are called, units included."""
        return tuple(self._columns)

    def __getitem__(self, name: str) -> Float[np.ndarray, "n"]:
        """The values of a column; NaN where a trajectory has none or its shard is damaged.

        Raises KeyError for a name that is not among ``names``.
        """
        if name not in self._columns:
            raise KeyError(f"there is no column {name!r}, only {', '.join(self.names)}")
        if name not in self._found:
            self._found[name] = self._read(self._columns[name])
        return self._found[name]

    def _read(self, column: Column) -> Float[np.ndarray, "n"]:
        parts, problems = [], []
        for shard in self._dataset.shards:
            try:
                values = self._dataset.read_shard(shard, [column.field])[column.field]
                parts.append(column.factor * _reduced(values, column.reduction))
            except ValueError as error:
                parts.append(np.full(len(self._dataset.manifest.rows(shard)), np.nan))
                problems.append(str(error))
        if problems:
            self._on_problem("\n".join([problems[0], f"{len(problems)} shards cannot be read."]))
        return np.concatenate(parts) if parts else np.zeros(0)


def curves(dataset: Dataset) -> list[str]:
    """The fields with one number for each state or each action, faults aside."""
    states = dataset.fields[points_field(dataset)].shape[0]
    along_time = [(states,), (states - 1,)]
    return [name for name, field in dataset.fields.items() if field.shape in along_time and name != "faults"]


def shown_as(field: str) -> tuple[str, float]:
    """What a field is called where it is shown, and the factor to its unit there."""
    unit, factor = UNITS.get(field, ("", 1.0))
    return f"{field.replace('_', ' ')}, {unit}" if unit else field.replace("_", " "), factor


def _reduced(values: np.ndarray, reduction: str) -> Float[np.ndarray, "k"]:
    if not reduction:
        return values.astype(float)
    if reduction == "any":
        return (values != 0).any(axis=1).astype(float)
    values = values.astype(float)
    known = np.isfinite(values).any(axis=1)
    result = np.full(len(values), np.nan)
    if known.any():
        result[known] = REDUCTIONS[reduction](values[known], axis=1)
    return result


def select(
    values: Float[np.ndarray, "n"], low: float | None, high: float | None, order: str
) -> Int[np.ndarray, "k"]:
    """The items whose value lies from ``low`` to ``high``, in an order.

    Args:
        values: one for each item.
        low: least value that is let through.
        high: greatest value; if both are None everything is let through, missing values too.
        order: "as stored", "ascending" or "descending"; missing values come last.
    """
    chosen = np.ones(len(values), dtype=bool)
    with np.errstate(invalid="ignore"):
        if low is not None:
            chosen &= values >= low
        if high is not None:
            chosen &= values <= high
    found = np.flatnonzero(chosen)
    if order == "as stored":
        return found
    keys = values[found] if order == "ascending" else -values[found]
    return found[np.argsort(keys, kind="stable")]
