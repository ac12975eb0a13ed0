"""Why a trial came out as it did: one plain sentence, read from what its record holds."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from doojax.experiments.trials.executed import execution_errors
from doojax.experiments.trials.judges import score_said
from doojax.experiments.trials.records import PlanRecord, TrialRecord
from doojax.experiments.trials.touching import gaps, obstacle_names, touched

SEARCHED = re.compile(r"(solved|exhausted|stuck), ([\d.]+) cm from the goal; (\d+) of (\d+) extensions")
TELLING = 0.1  # of a plan's largest error: where that much has come, it was left
BESIDE = 0.25  # of what a plan misses the goal by: a lesser error explains nothing
SWEPT = 4  # parts of a planned step, at whose ends the plan's rope is looked at
UNSTABLE = "the simulation became unstable"
MOST_NAMED = 2  # obstacles


@dataclass(frozen=True)
class Departure:
    """Where execution left a plan."""

    state: int
    error: float  # m there, root mean square over the rope's points
    largest: float  # m, of all states until the plan was given up
    score: float  # of the step that led there; NaN where it has none
    touching: tuple[str, ...]  # obstacles, there; where there are none, those of the state before
    still: bool  # touching them there, not only at the state before
    crossed: tuple[
        str, ...
    ]  # obstacles that the plan's own rope passes through on the way there or a step later


@dataclass(frozen=True)
class Search:
    """What came of one search."""

    step: int
    status: str  # solved, exhausted, stuck; "" where the record does not say
    missing: float  # m, between the plan's end and the goal
    accepted: int  # extensions
    extensions: int
    departure: Departure | None
    found: bool  # a plan that ends within the goal


def why(record: TrialRecord) -> str:
    """Why a trial ended as it did, as one sentence without a full stop.

    As it was written down when the record was made, or from what an older record holds.
    """
    return str(record.about["why"]) if "why" in record.about else explained(record)


def explained(record: TrialRecord) -> str:
    """`why`, worked out anew."""
    end = record.end
    if record.reached:
        return _of_success(record)
    if end.startswith(("crashed", "not wanted")) or not record.plans:
        return end
    searches = [_search(record, index) for index in range(len(record.plans))]
    if end.startswith("the plan was not to be executed"):
        return f"{end}; it ends {_cm(searches[-1].missing)} from the goal"
    broke = end == UNSTABLE
    last = len(record.points) - 1 if broke else len(record.points)  # a broken state is where nothing is
    left = [one for one in searches if one.departure is not None and one.departure.state < last]
    found, found_left = (sum(one.found for one in some) for some in (searches, left))
    parts, plans = _of_searches(record, searches), _plans(record.plans)
    if 2 * found >= len(searches) and left:  # there were plans to the goal: what came of them counts
        parts.insert(0, _of_departures(_departures(left), record, plans))
    elif found_left:  # what came of the others would not have led there
        some = _departures([one for one in left if one.found])
        parts.append(_of_departures(some, record, found, " that led to the goal"))
    elif any(one.departure and not one.departure.largest < BESIDE * one.missing for one in left):
        some = sorted(_departures(left), key=lambda one: one.largest, reverse=True)
        parts.append(_of_departures(some, record, plans, which="farthest"))
    if broke:
        return "; ".join([f"{end} at state {last}", *parts])
    if not parts:
        parts = ["execution went as planned, but the plans ended short of the goal"]
    return "; ".join([*parts, f"in the end the goal was {_cm(_missing(record))} away"])


def searched(record: TrialRecord) -> list[tuple[str, float, int, int]]:
    """Status, missing distance (m), accepted and all extensions of each search, as far as events say."""
    found = [SEARCHED.match(event.text) for event in record.events if event.kind == "plan"]
    return [
        (one[1], float(one[2]) / 100, int(one[3]), int(one[4])) if one else ("", np.nan, 0, 0)
        for one in found
    ]


def departure(record: TrialRecord, index: int) -> Departure | None:
    """Where execution left a plan: from there on to the largest error, no error is below a tenth of that.

    What was made good before does not count, nor does a trifle: an error below the threshold of the model
    error; where the record has none, below half the goal's radius, as what a trial remembers of refuted
    steps.
    """
    error = execution_errors(record)[index]
    threshold = record.about.get("error_threshold_m") or record.goal_radius / 2
    error = np.where(np.isfinite(error), error, np.inf)
    if not len(error) or error.max() < threshold:
        return None
    telling = max(threshold, TELLING * error[np.isfinite(error)].max(initial=0))
    at = int(np.flatnonzero(error[: np.argmax(error)] < telling).max(initial=-1)) + 1
    plan, names = record.plans[index], obstacle_names(record.obstacles)
    state, node = plan.step + at + 1, int(plan.path[at + 1])
    now, before = (
        touched(gaps(record.obstacles, record.points[i], record.grippers[i], record.look), names)
        for i in (state, state - 1)
    )
    touching = now or before
    crossed = sorted(_crossed(record, plan, at), key=lambda name: name not in touching)
    return Departure(
        state=state,
        error=float(error[at]),
        largest=float(error.max()),
        score=float(plan.score[node]) if plan.score is not None else np.nan,
        touching=tuple(touching[:MOST_NAMED]),
        still=bool(now),
        crossed=tuple(crossed),
    )


def _crossed(record: TrialRecord, plan: PlanRecord, at: int) -> list[str]:
    """What the axis of a plan's rope comes to lie in, from a step to the end of the next, the deepest first.

    Between two states every point goes straight: what the rope is on one side of before, and on the other
    after, was passed through.
    """
    nodes = plan.path[at : at + 3]
    part = np.linspace(0, 1, SWEPT, endpoint=False)[:, None, None, None]
    points, grippers = (_between(bodies[nodes], part) for bodies in (plan.points, plan.grippers))
    swept = [gaps(record.obstacles, *rope, record.look) for rope in zip(points, grippers, strict=True)]
    root = plan.path[0]  # which was executed, so that what it lies in a little stopped nothing
    before = gaps(record.obstacles, plan.points[root], plan.grippers[root], record.look)
    deepest, radius = np.min(swept, axis=0), record.look.rope_radius
    deeper = np.where(deepest < before - radius, deepest, np.inf)
    return touched(deeper, obstacle_names(record.obstacles), within=-radius)


def _between(
    bodies: Float[np.ndarray, "k K 3"], part: Float[np.ndarray, "s 1 1 1"]
) -> Float[np.ndarray, "n K 3"]:
    """States in a row with others between them, at parts of the way from each to the next."""
    between = bodies[:-1] + part * np.diff(bodies, axis=0)
    return np.concatenate([between.swapaxes(0, 1).reshape(-1, *bodies.shape[1:]), bodies[-1:]])


def _search(record: TrialRecord, index: int) -> Search:
    plan, said = record.plans[index], searched(record)
    status, missing, accepted, extensions = said[index] if index < len(said) else ("", np.nan, 0, 0)
    if not np.isfinite(missing):
        missing = _planned_missing(record, plan)
    found = status == "solved" or (status != "stuck" and missing <= record.goal_radius)
    return Search(plan.step, status, missing, accepted, extensions, departure(record, index), found)


def _planned_missing(record: TrialRecord, plan: PlanRecord) -> float:
    if not len(plan.path):
        return np.nan
    bodies = np.concatenate([plan.points[plan.path[-1]], plan.grippers[plan.path[-1]]])
    return float(np.linalg.norm(bodies[record.goal_point] - record.goal))


def _missing(record: TrialRecord) -> float:
    return float(record.about.get("final_error_m", _distances(record)[-1]))


def _distances(record: TrialRecord) -> Float[np.ndarray, "T1"]:
    return np.linalg.norm(record.goal_way - record.goal, axis=-1)


def _of_success(record: TrialRecord) -> str:
    count = len(record.plans)
    if not count:
        return record.end
    if count == 1:
        return "the first plan led to the goal"
    left = [departure(record, index) for index in range(count - 1)]
    found = [one for one in left if one is not None]
    text = f"plan {count} led to the goal"
    plans = _plans(record.plans[:-1])
    return f"{text}; before it {_of_departures(found, record, plans)}" if found else text


def _plans(plans: Sequence[PlanRecord]) -> int:
    """How many there are that could be executed: a search that is stuck makes none."""
    return sum(len(plan.path) > 1 for plan in plans)


def _departures(searches: Sequence[Search]) -> list[Departure]:
    return [one.departure for one in searches if one.departure is not None]


def _of_departures(
    left: Sequence[Departure],
    record: TrialRecord,
    plans: int,
    of: str = "",
    which: Literal["first", "farthest"] = "first",
) -> str:
    """Where plans were left: one of them in full, how many go through something, what was mostly touched.

    Args:
        left: one a plan; the first of them is told in full.
        record: whose plans they were.
        plans: how many there were.
        of: which plans, such as " that led to the goal".
        which: what the first of ``left`` is.
    """
    one = left[0]
    said, what = score_said(record.method, one.score), record.look.what
    touching = _listed(one.touching) if one.touching else "nothing"
    text = f"by {_cm(one.error)} at state {one.state}"
    text += f", where {said}" if said else ""
    text += f", touching {touching}" if one.still or not one.touching else f", having just touched {touching}"
    text += _of_crossed(one)
    if one.largest >= 2 * one.error and np.isfinite(one.largest):
        text += f", and by {_cm(one.largest)} later"
    if plans == 1:
        return f"the executed {what} left the plan{of} {text}"
    if len(left) == 1:
        return f"the executed {what} left one of {plans} plans{of}, {text}"
    through = sum(bool(each.crossed) for each in left)
    often = "all" if through == len(left) else f"{through}"
    often = f", {often} of which go through obstacles" if 2 * through >= len(left) else ""
    touches = Counter(name for each in left for name in each.touching)
    most, count = touches.most_common(1)[0] if touches else ("", 0)
    often += f", {count} times touching {most}" if count > 1 and 2 * count >= len(left) else ""
    full = f"it first left the plan {text}" if which == "first" else f"it left one farthest, {text}"
    return f"the executed {what} left {len(left)} of {plans} plans{of}{often}; {full}"


def _of_crossed(one: Departure) -> str:
    """What the plan goes through, in brackets: of what is touched, or anything else where that is none."""
    named = [name for name in one.crossed if name in one.touching] or one.crossed[:MOST_NAMED]
    if not named:
        return ""
    if set(named) == set(one.touching):
        return f" (the plan goes through {'it' if len(named) == 1 else 'them'})"
    return f" (the plan goes through {_listed(named)})"


def _of_searches(record: TrialRecord, searches: Sequence[Search]) -> list[str]:
    """What searches found no plan, and why."""
    stuck = [one for one in searches if one.status == "stuck"]
    short = [one for one in searches if one.status == "exhausted" and not one.found]
    parts = []
    if stuck:
        total = sum(one.extensions for one in stuck)
        first, last = stuck[0].step, stuck[-1].step
        where = f"state {first}" if first == last else f"states {first} to {last}"
        count = "a search" if len(stuck) == 1 else f"{len(stuck)} searches"
        text = f"{count} found no plan at {where}: all {total} extensions from the start were rejected"
        gap = gaps(record.obstacles, record.points[last], record.grippers[last], record.look)
        near = touched(gap, obstacle_names(record.obstacles))[:MOST_NAMED]
        parts.append(text + (f", the {record.look.what} touching {_listed(near)}" if near else ""))
    if short:
        nearest = min(one.missing for one in short)
        count = "a search" if len(short) == 1 else f"{len(short)} searches"
        rejected = 1 - sum(one.accepted for one in short) / max(sum(one.extensions for one in short), 1)
        text = f"{count} found no way to the goal, none nearer than {_cm(nearest)}"
        parts.append(text + f" ({100 * rejected:.0f} % of extensions rejected)")
    return parts


def _listed(names: Sequence[str]) -> str:
    return " and ".join(names)


def _cm(metres: float) -> str:
    if not np.isfinite(metres):
        return "an unknown distance"
    return f"{100 * metres:.0f} cm" if metres >= 0.1 else f"{100 * metres:.1f} cm"
