"""How good a judge of transitions is: counts, ranking, calibration."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import rankdata

BINS = 15  # of probabilities, for calibration


@dataclass(frozen=True)
class Counts:
    """What became of n judged transitions, or of several such samples: numbers, or arrays of them."""

    accepted_right: int | np.ndarray
    accepted_wrong: int | np.ndarray
    rejected_right: int | np.ndarray
    rejected_wrong: int | np.ndarray

    @property
    def accuracy(self) -> float | np.ndarray:
        """Which fraction was judged as it was."""
        return _ratio(
            self.accepted_right + self.rejected_wrong,
            self.accepted_right + self.accepted_wrong + self.rejected_right + self.rejected_wrong,
        )

    @property
    def precision(self) -> float | np.ndarray:
        """Which fraction of those accepted was right; NaN if none was accepted."""
        return _ratio(self.accepted_right, self.accepted_right + self.accepted_wrong)

    @property
    def recall(self) -> float | np.ndarray:
        """Which fraction of those that were right was accepted."""
        return _ratio(self.accepted_right, self.accepted_right + self.rejected_right)

    @property
    def specificity(self) -> float | np.ndarray:
        """Which fraction of those that were wrong was rejected."""
        return _ratio(self.rejected_wrong, self.rejected_wrong + self.accepted_wrong)


def counts(accepted: Bool[np.ndarray, "n"], right: Bool[np.ndarray, "n"]) -> Counts:
    """The four counts."""
    return Counts(
        accepted_right=int((accepted & right).sum()),
        accepted_wrong=int((accepted & ~right).sum()),
        rejected_right=int((~accepted & right).sum()),
        rejected_wrong=int((~accepted & ~right).sum()),
    )


def auroc(scores: Float[np.ndarray, "n"], right: Bool[np.ndarray, "n"]) -> float:
    """The probability that a right transition scores above a wrong one, ties counting half.

    The area under the receiver operating characteristic, by ranks (Mann and Whitney 1947).

    Raises:
        ValueError: one class is missing.
    """
    positives, negatives = int(right.sum()), int((~right).sum())
    if not positives or not negatives:
        raise ValueError(f"AUROC needs both classes; there are {positives} right and {negatives} wrong")
    ranks = rankdata(scores)
    return float((ranks[right].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def reliability_diagram(
    probabilities: Float[np.ndarray, "n"], right: Bool[np.ndarray, "n"], bins: int = BINS
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Mean probability, fraction right, and share of the examples, for each of the m bins that hold any."""
    index = np.clip((probabilities * bins).astype(int), 0, bins - 1)
    size = np.bincount(index, minlength=bins)
    filled = size > 0
    mean = np.bincount(index, weights=probabilities, minlength=bins)[filled] / size[filled]
    true = np.bincount(index, weights=right.astype(float), minlength=bins)[filled] / size[filled]
    return mean, true, size[filled] / len(right)


def expected_calibration_error(
    probabilities: Float[np.ndarray, "n"], right: Bool[np.ndarray, "n"], bins: int = BINS
) -> float:
    """How far probabilities are from frequencies: the mean over bins, weighted by their examples."""
    mean, true, share = reliability_diagram(probabilities, right, bins)
    return float((share * np.abs(mean - true)).sum())


def _ratio(part: int | np.ndarray, whole: int | np.ndarray) -> float | np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.true_divide(part, whole)
