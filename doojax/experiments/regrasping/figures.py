"""How trials of arms came out: figures by method, and paired tests over the scenes that methods share."""

from collections.abc import Mapping, Sequence

import numpy as np

from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import bootstrap, mcnemar, success_rate
from doojax.experiments.reports.summary import row
from doojax.experiments.trials.records import TrialRecord

# Figure -> what of a record's `about` it is, in which unit, and what a unit of that is.
MEANS = {
    "planning_min": ("planning_s", "min", 60.0),
    "executing_min": ("executing_s", "min", 60.0),
    "sim_min": ("simulated_s", "min", 60.0),
    "grasps": ("grasps", "", 1.0),
    "iterations": ("iterations", "", 1.0),
}


def rows_of(environment: str, records: Mapping[str, Sequence[TrialRecord]]) -> list[Row]:
    """Rates of success, means over all trials, and tests of each method against the first.

    ``wall_min`` is what planning and executing took together; ``sim_min`` is the time that passed in the
    simulated world, in which planning takes none.
    """
    rows: list[Row] = []
    reached = {name: np.array([one.reached for one in own]) for name, own in records.items()}
    for name, own in records.items():
        tags = {"environment": environment, "method": name}
        rate = success_rate(reached[name])
        rows.append(row("success_rate", tags, rate.value, "", rate.low, rate.high, rate.n))
        wall = np.array([one.about["planning_s"] + one.about["executing_s"] for one in own]) / 60
        rows.append(_mean("wall_min", tags, wall, "min"))
        for metric, (key, unit, scale) in MEANS.items():
            rows.append(_mean(metric, tags, np.array([one.about[key] for one in own]) / scale, unit))
        planned = [one for record in own for one in record.about["regrasps"]]
        if planned:
            seconds = np.array([one["planning_s"] for one in planned])
            rows.append(_mean("plan_grasp_s", tags, seconds, "s"))
            count = sum(len(one["candidates"]) for one in planned)
            rows.append(row("candidates_per_s", tags, count / seconds.sum(), "1/s", n=len(planned)))
            off = np.array([one["rope_off_mean"] for one in planned if "rope_off_mean" in one])
            if len(off):
                rows.append(_mean("rope_off_m", tags, off, "m"))
    first, *others = records
    for name in others:
        test = mcnemar(reached[first], reached[name])
        tags = {"environment": environment, "method": first, "against": name, "test": "mcnemar"}
        rows.append(row("p_value", tags, test.p_value, "", n=test.difference.n))
    return rows


def _mean(metric: str, tags: dict, values: np.ndarray, unit: str) -> Row:
    found = bootstrap(values.astype(float), np.mean)
    return row(metric, tags, found.value, unit, found.low, found.high, found.n)
