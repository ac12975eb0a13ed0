"""How trials of arms came out: figures by method, and paired tests over the scenes that methods share."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from doojax.experiments.regrasping.trial import Trial
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import bootstrap, mcnemar, success_rate
from doojax.experiments.reports.summary import row

MINUTE = 60.0
# Means over all trials: figure -> unit, and its value for one trial.
MEANS: dict[str, tuple[str, Callable[[Trial], float]]] = {
    "wall_min": ("min", lambda one: one.seconds.wall / MINUTE),
    "control_min": ("min", lambda one: one.seconds.control / MINUTE),
    "plan_grasps_min": ("min", lambda one: one.seconds.plan_grasps / MINUTE),
    "executing_min": ("min", lambda one: one.seconds.execute / MINUTE),
    "sim_min": ("min", lambda one: one.record.about["simulated_s"] / MINUTE),
    "grasps": ("", lambda one: one.record.about["grasps"]),
    "iterations": ("", lambda one: one.record.about["iterations"]),
}


def rows_of(environment: str, trials: Mapping[str, Sequence[Trial]]) -> list[Row]:
    """Rates of success, means over all trials, and tests of each method against the first.

    ``wall_min`` is what control, planning grasps and executing took together, of which the first two are
    planning; ``sim_min`` is the time that passed in the simulated world, in which planning takes none;
    ``wall_of_success_min`` is the median of the trials that succeeded.
    """
    rows: list[Row] = []
    reached = {name: np.array([one.record.reached for one in own]) for name, own in trials.items()}
    for name, own in trials.items():
        tags = {"environment": environment, "method": name}
        rate = success_rate(reached[name])
        rows.append(row("success_rate", tags, rate.value, "", rate.low, rate.high, rate.n))
        for metric, (unit, value) in MEANS.items():
            rows.append(_row(metric, tags, [value(one) for one in own], unit))
        if reached[name].any():
            walls = [one.seconds.wall / MINUTE for one in own if one.record.reached]
            rows.append(_row("wall_of_success_min", tags, walls, "min", np.median))
        rows += _of_plannings(tags, own)
    first, *others = trials
    for name in others:
        shared = min(len(reached[first]), len(reached[name]))
        test = mcnemar(reached[first][:shared], reached[name][:shared])
        tags = {"environment": environment, "method": first, "against": name, "test": "mcnemar"}
        rows.append(row("p_value", tags, test.p_value, "", n=test.difference.n))
    return rows


def _of_plannings(tags: dict, trials: Sequence[Trial]) -> list[Row]:
    """Seconds of each planning of a grasp, candidates in a second, and how far what was executed is from what
    was planned."""
    notes = [note for one in trials for note in one.record.about["regrasps"]]
    seconds = np.array([took["planning"] for one in trials for took in one.seconds.regrasps])
    if not notes:
        return []
    count = sum(len(note["candidates"]) for note in notes)
    rows = [
        _row("plan_grasp_s", tags, seconds, "s"),
        row("candidates_per_s", tags, count / seconds.sum(), "1/s", n=len(notes)),
    ]
    off = [note["rope_off_mean"] for note in notes if "rope_off_mean" in note]
    if off:
        alike = [note["planned_signature"] == note["executed_signature"] for note in notes if note["changed"]]
        rows.append(_row("rope_off_m", tags, off, "m"))
        if alike:
            rows.append(_row("signature_as_planned", tags, alike, ""))
    return rows


def _row(
    metric: str,
    tags: dict,
    values: Sequence | np.ndarray,
    unit: str,
    statistic: Callable[..., np.ndarray] = np.mean,
) -> Row:
    found = bootstrap(np.asarray(values, float), statistic)
    return row(metric, tags, found.value, unit, found.low, found.high, found.n)
