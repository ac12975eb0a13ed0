"""The figures of `doojax.benchmarks.planner` as rows."""

from collections.abc import Callable
from typing import Any

import numpy as np

from doojax.benchmarks.ompl_peer import Found
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import bootstrap
from doojax.experiments.reports.summary import row


def rate_rows(results: dict[str, list[Found]], **tags: str | int) -> list[Row]:
    """Accepted extensions per second, and how many times OMPL's ours are."""
    rates = {name: np.array([one.accepted / one.seconds for one in found]) for name, found in results.items()}
    rows = [
        _row("extensions_per_s", {"planner": name, **tags}, values, "1/s", np.median)
        for name, values in rates.items()
    ]
    ratio = rates["doojax"] / rates["ompl"]
    return [*rows, _row("extensions_speedup", {**tags, "against": "ompl"}, ratio, "", np.median)]


def solution_rows(task: str, results: dict[str, list[Found]]) -> list[Row]:
    """Seconds to a solution where both planners find one, and the share of problems that each solves."""
    rows = []
    both = [all(one.solved for one in pair) for pair in zip(*results.values(), strict=True)]
    for name, found in results.items():
        tags = {"planner": name, "task": task}
        if any(both):
            seconds = np.array([one.seconds for one in found])
            rows.append(_row("time_to_solution_s", tags, seconds[both], "s", np.median))
        solved = sum(one.solved for one in found)
        rows.append(row("solved", tags, solved / len(found), "", n=len(found)))
    return rows


def sampler_rows(task: str, extensions: dict[str, np.ndarray]) -> list[Row]:
    """Geometric means of the extensions to a solution."""
    return [
        _row("extensions_to_solution", {"task": task, "sample": name}, values, "", _geometric_mean)
        for name, values in extensions.items()
    ]


def _row(
    metric: str, tags: dict[str, Any], values: np.ndarray, unit: str, statistic: Callable[..., Any]
) -> Row:
    found = bootstrap(values, statistic)
    return row(metric, tags, found.value, unit, found.low, found.high, found.n)


def _geometric_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.exp(np.log(values).mean(axis))
