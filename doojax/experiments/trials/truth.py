"""Trials of a robot that is off: which errors it made, and how near to the goal the rope truly came."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from doojax.experiments.trials.execution import distances
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.replay import TRACKING
from doojax.experiments.trials.setting import Trials
from doojax.keys import numbered, stream
from doojax.simulation.tracking import Tracked

AS_SEEN = "the goal was reached as the rope was seen, and not in truth"


def tracking_keys(trials: Trials) -> Key[Array, "R"]:
    """Of each trial's errors: a random stream of its own."""
    return numbered(stream(trials.seed, f"{trials.purpose} tracking"), np.asarray(trials.numbers, np.uint32))


def with_truth(
    records: Sequence[TrialRecord], simulator: Tracked, states: Any, trials: Trials
) -> list[TrialRecord]:
    """Records whose goals count as reached where they are in truth.

    Their ``final_error_m`` is the true one, ``seen_error_m`` that of what was seen.
    """
    errors = np.asarray(distances(trials.goals, simulator.truth(states)))
    data = np.asarray(jax.random.key_data(tracking_keys(trials)))
    found = []
    for record, error, own in zip(records, errors, data, strict=True):
        about = {
            **record.about,
            "seen_error_m": record.about["final_error_m"],
            "final_error_m": float(error),
            "tracking": asdict(simulator.tracking),
        }
        reached = bool(record.reached and error <= record.goal_radius)
        events = record.events
        if record.reached and not reached:
            about |= {"end": AS_SEEN, "why": f"{AS_SEEN}: {100 * error:.1f} cm are missing"}
            events = (*events[:-1], replace(events[-1], text=AS_SEEN))
        kept = {**record.replay, TRACKING: own}
        found.append(replace(record, about=about, events=events, reached=reached, replay=kept))
    return found
