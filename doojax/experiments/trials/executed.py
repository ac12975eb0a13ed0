"""What became of the transitions that plans were made of, when they were executed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from doojax.experiments.reports.statistics import Estimate
from doojax.experiments.trials.records import PlanRecord, TrialRecord
from doojax.keys import generator

RESAMPLES = 9999


def execution_errors(record: TrialRecord) -> list[Float[np.ndarray, "t"]]:
    """Of every plan that was executed, the model error after each executed action, metres.

    It is the root mean square over the rope's points of their distances from where the plan had them, as in
    `doojax.learning.labels.rms_distance`. Recoveries follow no plan and are left out.
    """
    steps = [plan.step for plan in record.plans] + [len(record.points) - 1]
    ends = zip(record.plans, steps[1:], strict=True)
    return [_errors(plan, record.points[plan.step : end + 1]) for plan, end in ends]


class Followed(NamedTuple):
    """What a trial's plans had to say of every executed state."""

    plan: Int[np.ndarray, "T1"]  # the plan that led there; -1 where none did
    node: Int[np.ndarray, "T1"]  # where that plan expected to be; -1 where it did not
    error: Float[np.ndarray, "T1"]  # m, root mean square over the rope's points; NaN without a node
    score: Float[np.ndarray, "T1"]  # of the step that led there, as the reliability gave it


def followed(record: TrialRecord) -> Followed:
    """Which plan led to each executed state, and how far that was from where the plan expected it.

    Where one plan ends and the next begins, the state counts for the one that led there.
    """
    count = len(record.points)
    plan, node = np.full(count, -1), np.full(count, -1)
    error, score = np.full(count, np.nan), np.full(count, np.nan)
    for index, (one, errors) in enumerate(zip(record.plans, execution_errors(record), strict=True)):
        if node[one.step] < 0 and len(one.path):
            plan[one.step], node[one.step], error[one.step] = index, one.path[0], 0.0
        states = one.step + 1 + np.arange(len(errors))
        nodes = one.path[1 : 1 + len(errors)]
        plan[states], node[states], error[states] = index, nodes, errors
        if one.score is not None:
            score[states] = one.score[nodes]
    return Followed(plan, node, error, score)


def judged_transitions(record: TrialRecord, threshold: float) -> tuple[int, int]:
    """How many executed transitions of plans were accepted, and how many of those were wrong.

    As for labels, those count that begin where the prediction was still right: once a plan was off by the
    threshold (m) of the model error, nothing that follows in it is judged. All that is executed was accepted.
    """
    accepted = wrong = 0
    for error in execution_errors(record):
        off = np.flatnonzero(~(error < threshold))
        accepted += int(off[0]) + 1 if off.size else len(error)
        wrong += bool(off.size)
    return accepted, wrong


def wrong_among_accepted(counts: Int[np.ndarray, "n 2"], *, seed: int = 0) -> Estimate | None:
    """The rate of wrong transitions among those of n trials, with a bootstrap interval over the trials.

    Args:
        counts: for each trial what `judged_transitions` gave.
        seed: of the resampling.

    Returns:
        the estimate, whose n are the trials; None where no trial executed a transition of a plan.
    """
    counts = counts[counts[:, 0] > 0]
    if not len(counts):
        return None
    drawn = generator(seed, "wrong among accepted").integers(len(counts), size=(RESAMPLES, len(counts)))
    accepted, wrong = counts[drawn].sum(1).T
    low, high = np.quantile(wrong / accepted, [0.025, 0.975])
    total = counts.sum(0)
    return Estimate(float(total[1] / total[0]), float(low), float(high), len(counts))


def counts_of(records: Sequence[TrialRecord]) -> Int[np.ndarray, "n 2"]:
    """`judged_transitions` of every trial, at its record's own threshold; zeros where it has none."""
    found = []
    for record in records:
        threshold = record.about.get("error_threshold_m")
        found.append(judged_transitions(record, float(threshold)) if threshold is not None else (0, 0))
    return np.array(found, dtype=int).reshape(-1, 2)


def _errors(plan: PlanRecord, executed: Float[np.ndarray, "t1 N 3"]) -> Float[np.ndarray, "t"]:
    predicted = plan.points[plan.path][1 : len(executed)]
    gaps = predicted - executed[1 : 1 + len(predicted)]
    return np.sqrt((gaps**2).sum(-1).mean(-1))
