"""What the scores of judges of reliability mean, in words, and where they accept."""

import math
from typing import Any

from doojax.models import Always, CollisionChecker, Conjunction

UNLEARNED = {"always": Always, "collision_checker": CollisionChecker}
EXPECTED = "expected error, m"
# Method or kind of a judge -> what its scores are called.
SCORES = {
    "classifier": "accept probability",
    "voxel_classifier": "accept probability",
    "learned_recovery": "accept probability",
    "random_recovery": "accept probability",
    "deviation": EXPECTED,
    "focus": EXPECTED,
    "all_data": EXPECTED,
    "collision_checker": "clearance, m",
}


def name_of_score(judge: str) -> str:
    """What the scores of a judge are called, by its kind or the method that plans with it."""
    return SCORES.get(judge, "score")


def score_said(judge: str, score: float) -> str:
    """A judge's score in words, such as "the classifier said 0.93"; "" for methods that judge nothing."""
    meaning = SCORES.get(judge)
    if meaning is None or score != score:
        return ""
    if meaning == "accept probability":
        return f"the classifier said {score:.2f}"
    if meaning == EXPECTED:
        return f"an error of {100 * score:.1f} cm was expected"
    return f"the collision checker saw {100 * score:.1f} cm of room"


def threshold_of(judge: Any) -> float | None:
    """The score at which a judge's verdict changes, in the score's unit; None where it has none.

    Of several judges that must all accept, that of the first, whose scores are recorded.
    """
    if isinstance(judge, Conjunction):
        return threshold_of(judge.judges[0])
    for name in ("limit", "threshold", "margin"):  # of an estimator of deviations, a classifier, a checker
        value = getattr(judge, name, None)
        if value is not None and math.isfinite(float(value)):
            return float(value)
    return None
