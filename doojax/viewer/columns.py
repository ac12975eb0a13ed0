"""Numbers by which the trajectories of a data set are filtered and sorted."""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float, Int

from doojax.datasets import Dataset

REDUCTIONS = {"max": np.nanmax, "min": np.nanmin, "mean": np.nanmean}


class Columns:
    """One number for each trajectory, from any stored field that has one number per state at most.

    A column is read when it is first asked for, a shard at a time.
    """

    def __init__(self, dataset: Dataset, on_problem: Callable[[str], None]):
        """Columns of a data set; ``on_problem`` is told of shards that cannot be read."""
        self._dataset = dataset
        self._on_problem = on_problem
        self._found: dict[str, np.ndarray] = {}
        self.names = tuple(_names(dataset))

    def __getitem__(self, name: str) -> Float[np.ndarray, "n"]:
        """The values of a column; NaN where a trajectory has none or its shard is damaged.

        Raises KeyError for a name that is not among ``names``.
        """
        if name not in self.names:
            raise KeyError(f"there is no column {name!r}, only {', '.join(self.names)}")
        if name not in self._found:
            self._found[name] = self._read(name)
        return self._found[name]

    def _read(self, name: str) -> Float[np.ndarray, "n"]:
        field, _, reduction = name.partition(" ")
        parts, problems = [], []
        for shard in self._dataset.shards:
            try:
                values = self._dataset.read_shard(shard, [field])[field]
                parts.append(_reduced(values, reduction))
            except ValueError as error:
                parts.append(np.full(len(self._dataset.manifest.rows(shard)), np.nan))
                problems.append(str(error))
        if problems:
            self._on_problem("\n".join([problems[0], f"{len(problems)} shards cannot be read."]))
        return np.concatenate(parts) if parts else np.zeros(0)


def _names(dataset: Dataset) -> Iterator[str]:
    for name, field in dataset.fields.items():
        if name == "faults":
            yield "faults any"
        elif len(field.shape) == 1 and _along_time(dataset, field.shape[0]):
            yield from (f"{name} {reduction}" for reduction in REDUCTIONS)
        elif field.shape == ():
            yield name


def _along_time(dataset: Dataset, length: int) -> bool:
    states = dataset.fields["points"].shape[0]
    return length in (states, states - 1)


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
    """The trajectories whose value lies from ``low`` to ``high``, in an order.

    Args:
        values: one for each trajectory.
        low: least value that is let through; None lets everything through, missing values too.
        high: greatest value.
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
