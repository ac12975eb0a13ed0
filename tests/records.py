"""Records of trials, made by hand."""

from typing import Any

import numpy as np
from jaxtyping import Float

from doojax.experiments.trials.records import Look, TrialRecord
from doojax.viewer.episodes import no_obstacles


def record_of(points: Float[np.ndarray, "T1 N 3"], **others: Any) -> TrialRecord:
    """A trial of the toy in which these points were somewhere, and nothing else was; but for ``others``."""
    usual: dict[str, Any] = {
        "task": "toy",
        "method": "classifier",
        "seed": 0,
        "look": Look(0.01),
        "obstacles": no_obstacles(),
        "goal": np.zeros(3),
        "goal_radius": 0.05,
        "goal_point": 0,
        "grippers": points[:, :1],
        "plans": (),
        "events": (),
        "reached": False,
    }
    return TrialRecord(points=points, **usual | others)
