"""``doojax inspect``: what a data set holds, and whether it is sound."""

import hashlib
import json
import math
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from doojax.datasets.collect import command_of
from doojax.datasets.diversity import diversity
from doojax.datasets.store import Dataset
from doojax.simulation.state import Fault
from doojax.terminal import labelled
from doojax.types import Verdict

QUATERNION_TOLERANCE = 1e-5  # a few roundings of float32
STRETCH_BOUNDS = (0.01, 0.03)


@dataclass
class FieldStatistics:
    """Running count, range, mean and spread of the finite values of one field."""

    count: int = 0
    missing: int = 0  # NaN
    minimum: float = math.inf
    maximum: float = -math.inf
    mean: float = 0.0
    squares: float = 0.0  # sum of squared distances to the mean

    def add(self, values: np.ndarray) -> None:
        """Count in more values, by the update of Chan, Golub and LeVeque (1983)."""
        self.missing += int(np.isnan(values).sum())
        numbers = values[np.isfinite(values)].astype(np.float64)
        if not numbers.size:
            return
        total = self.count + numbers.size
        shift = numbers.mean() - self.mean
        self.squares += numbers.var() * numbers.size + shift**2 * self.count * numbers.size / total
        self.mean += shift * numbers.size / total
        self.count = total
        self.minimum = min(self.minimum, float(numbers.min()))
        self.maximum = max(self.maximum, float(numbers.max()))

    @property
    def deviation(self) -> float:
        """Standard deviation."""
        return math.sqrt(self.squares / self.count) if self.count else math.nan


@dataclass
class Summary:
    """What one pass over a data set finds."""

    statistics: dict[str, FieldStatistics]
    facts: dict[str, tuple[int, int]]  # what was counted, how often, out of how many
    checks: dict[str, list[str]] = field(default_factory=dict)  # what was checked, what is wrong


def inspect(path: Path, /, *, verify: bool = True) -> None:
    """Print a data set's fields, statistics and config, and check that it is sound.

    Args:
        path: The data set's folder.
        verify: Compare every file with its checksum.

    Raises:
        FileNotFoundError: where there is no folder.
        ValueError: where it holds no data set, or one that fails a check, saying which.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the title says whether it is unfinished
        dataset = Dataset.open(path)
    console = Console(soft_wrap=True)
    console.print(f"[bold]{escape(str(path))}[/]: {_size(dataset)}")
    console.print("config", json.dumps(dataset.config, indent=2), markup=False)
    versions = ", ".join(f"{name} {text}" for name, text in dataset.manifest.versions.items())
    console.print("made with", versions, markup=False)
    command = command_of(dataset.manifest, path)
    if command is not None:
        console.print("made by", command, markup=False)
    if verify:
        dataset.verify()
    summary = summarise(dataset)
    console.print(_table(dataset, summary), soft_wrap=False)
    for label, (hits, total) in summary.facts.items():
        console.print(f"{label}: {hits} of {total} ({hits / total:.2%})")
    if "verdict" in dataset.fields and len(dataset):
        _tell_diversity(dataset, console)
    console.print(f"checksums: {'ok' if verify else 'not checked'}")
    for check, problems in summary.checks.items():
        console.print(f"{check}: {'[red]FAILED' if problems else 'ok'}")
    found = [f"{check}: {problem}" for check, problems in summary.checks.items() for problem in problems]
    if found:
        raise ValueError("\n".join([f"{path} fails its checks:", *found]))


def _tell_diversity(dataset: Dataset, console: Console) -> None:
    found = diversity(dataset)
    if found is None:
        console.print("diversity: no augmentation is accepted")
        return
    told = f"{found.drawn:.3f} nats as drawn, {found.accepted:.3f} as accepted"
    console.print(f"divergence of transforms from uniform: {told}")
    console.print(f"median distance of an augmentation to the nearest original: {100 * found.nearest:.1f} cm")


def summarise(dataset: Dataset) -> Summary:
    """Statistics of every field and the checks of values, with one shard in memory at a time.

    Raises:
        ValueError: for a damaged chunk file, naming it.
    """
    statistics = {name: FieldStatistics() for name in dataset.fields}
    hits, totals = Counter(), Counter()
    not_finite, not_unit = Counter(), Counter()
    digests: list[bytes] = []
    for shard in dataset.shards:
        arrays = dataset.read_shard(shard)
        for name, values in arrays.items():
            statistics[name].add(values)
            may_be_missing = dataset.fields[name].may_be_missing
            not_finite[name] += int((np.isinf(values) if may_be_missing else ~np.isfinite(values)).sum())
            if name.endswith("quaternion"):
                norms = np.linalg.norm(values.astype(np.float64), axis=-1)
                not_unit[name] += int((np.abs(norms - 1) > QUATERNION_TOLERANCE).sum())
        for label, mask in _marks(arrays):
            hits[label] += int(mask.sum())
            totals[label] += mask.size
        digests += _digests(arrays)
    checks = {
        "finite": [f"{name}: {count} values are not" for name, count in not_finite.items() if count],
        "unit quaternions": [f"{name}: {count} are not" for name, count in not_unit.items() if count],
        "distinct trajectories": _repeats(digests, dataset.rows),
    }
    return Summary(statistics, {label: (hits[label], totals[label]) for label in totals}, checks)


def _marks(arrays: dict[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    if "faults" in arrays:
        bits = np.bitwise_or.reduce(arrays["faults"], axis=1)
        yield "trajectories with a fault", bits != 0
        for fault in Fault:
            yield f"trajectories with {fault.name}", (bits & fault.value) != 0
    if "clearance" in arrays:
        yield "states within 1 mm of an obstacle", arrays["clearance"] < 0.001
        yield "trajectories within 1 mm of an obstacle", (arrays["clearance"] < 0.001).any(axis=1)
        yield "states more than 2 mm inside an obstacle", arrays["clearance"] < -0.002
    if "verdict" in arrays:
        tried = arrays["verdict"][arrays["verdict"] != Verdict.ORIGINAL]
        for verdict in Verdict:
            if verdict != Verdict.ORIGINAL:
                yield f"augmentations: {verdict.name.lower().replace('_', ' ')}", tried == verdict
    if "stretch" in arrays:
        for bound in STRETCH_BOUNDS:
            yield f"states stretched by more than {bound:.0%}", arrays["stretch"] > bound


def _digests(arrays: dict[str, np.ndarray]) -> list[bytes]:
    """One short hash for each trajectory, over everything but the number of its scene."""
    count = len(next(iter(arrays.values())))
    hashes = [hashlib.blake2b(digest_size=16) for _ in range(count)]
    for name, values in arrays.items():
        if name != "environment":
            for trajectory, one_hash in zip(values, hashes, strict=True):
                one_hash.update(trajectory.tobytes())
    return [one_hash.digest() for one_hash in hashes]


def _repeats(digests: list[bytes], rows: np.ndarray) -> list[str]:
    first: dict[bytes, int] = {}
    pairs = [
        (row, first[digest])
        for digest, row in zip(digests, rows, strict=True)
        if first.setdefault(digest, row) != row
    ]
    lines = [f"trajectory {row} repeats trajectory {original}" for row, original in pairs[:5]]
    return lines + [f"... {len(pairs)} repeat another"] * (len(pairs) > 5)


def _size(dataset: Dataset) -> str:
    manifest = dataset.manifest
    stored = sum(file.stat().st_size for file in dataset.path.rglob("*") if file.is_file())
    state = "complete" if dataset.complete else f"UNFINISHED, of {manifest.trajectories} in {manifest.shards}"
    return f"{len(dataset)} trajectories in {len(dataset.shards)} shards ({state}), {stored / 1e6:.1f} MB"


def _table(dataset: Dataset, summary: Summary) -> Table:
    missing = any(one.missing for one in summary.statistics.values())
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("field, dtype, shape, unit", no_wrap=True)
    for heading in ("min", "max", "mean", "std", *["missing"] * missing):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, one in summary.statistics.items():
        about = dataset.fields[name]
        numbers = (one.minimum, one.maximum, one.mean, one.deviation) if one.count else (math.nan,) * 4
        kind = ", ".join((about.dtype, " ".join(map(str, about.shape)) or "one", about.unit))
        table.add_row(
            labelled(name, kind), *(f"{value:.3g}" for value in numbers), *[str(one.missing)] * missing
        )
    return table
