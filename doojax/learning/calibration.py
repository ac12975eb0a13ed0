"""Fit what a classifier's output means, and choose thresholds that keep a promise, on a split of its own."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from doojax.models.calibration import Calibration

SMALLEST = 1e-6  # m, below which a deviation counts as none


def fit_calibration(logits: Float[np.ndarray, "n"], right: Bool[np.ndarray, "n"]) -> Calibration:
    """The scale and the shift that make the probabilities most likely (Platt 1999), never turning them round.

    Raises:
        ValueError: one class is missing.
    """
    if right.all() or not right.any():
        raise ValueError(
            f"all {len(right)} calibration examples are {'right' if right.all() else 'wrong'}: a classifier "
            "cannot be calibrated on one class; collect more data, or choose another threshold"
        )
    signs = np.where(right, 1.0, -1.0)

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        log_scale, shift = parameters
        scale = np.exp(log_scale)
        margin = signs * (scale * logits + shift)
        slope = -signs / (1 + np.exp(np.clip(margin, -50, 50)))
        gradient = np.array([(slope * logits).mean() * scale, slope.mean()])
        return float(np.logaddexp(0, -margin).mean()), gradient

    found = minimize(loss, np.zeros(2), jac=True, method="BFGS")
    return Calibration(float(np.exp(found.x[0])), float(found.x[1]))


def conformal_threshold(
    scores: Float[np.ndarray, "n"],
    right: Bool[np.ndarray, "n"],
    alpha: float,
    trajectory: Int[np.ndarray, "n"] | None = None,
) -> float:
    """The least threshold above which at most the fraction ``alpha`` of transitions is wrong.

    Of n exchangeable examples, it counts one more wrong than it sees: it is the least score t such that
    (1 + number wrong with scores above t) / (number with scores above t) is at most alpha, the rule by which
    conformal selection controls the false discovery rate (Jin and Candes 2023). Accept scores greater than
    it.

    Transitions of one trajectory are alike; only trajectories are exchangeable. So where ``trajectory`` says
    which each is from, one more trajectory counts as wrong throughout, with as many transitions above t as
    those that have any have on average. The promise is then kept on average over sets of trajectories, not
    given one, and for transitions that were drawn as these were: a planner chooses its own.

    Args:
        scores: of n transitions.
        right: which of them were right.
        alpha: the rate.
        trajectory: numbers of their trajectories; by default each is its own.

    Returns:
        the threshold; infinite where no threshold keeps the promise: accept nothing.

    Raises:
        ValueError: alpha is not between 0 and 1.
    """
    if not 0 < alpha < 1:
        raise ValueError(f"alpha is {alpha}, expected a rate between 0 and 1")
    order = np.argsort(-scores, kind="stable")
    ranked, wrong = scores[order], np.cumsum(~right[order])
    count = np.arange(1, len(scores) + 1)
    first = np.ones(len(scores), dtype=bool)
    if trajectory is not None:
        first[:] = False
        first[np.unique(trajectory[order], return_index=True)[1]] = True
    keeps = (count / np.cumsum(first) + wrong) / count <= alpha
    keeps &= np.append(ranked[1:] < ranked[:-1], True)  # a threshold accepts all of equal scores or none
    if not keeps.any():
        return float("inf")
    last = int(np.flatnonzero(keeps)[-1])
    below = ranked[last + 1] if last + 1 < len(ranked) else ranked[last] - 1.0
    return float((ranked[last] + below) / 2)


def fit_power(predicted: Float[np.ndarray, "n"], true: Float[np.ndarray, "n"]) -> tuple[float, float]:
    """Power, not negative, and shift by which log true = shift + power log predicted, by least squares.

    So predictions come to be right in their geometric mean, at small and at large values; both m.

    Raises:
        ValueError: for no values.
    """
    if not len(predicted):
        raise ValueError("there are no examples to calibrate with")
    x, y = (np.log(np.asarray(values, float) + SMALLEST) for values in (predicted, true))
    spread = x.var()
    power = max(((x - x.mean()) * (y - y.mean())).mean() / spread, 0.0) if spread > 0 else 1.0
    return float(power), float(y.mean() - power * x.mean())


def conformal_factor(
    predicted: Float[np.ndarray, "n"],
    true: Float[np.ndarray, "n"],
    alpha: float,
    trajectory: Int[np.ndarray, "n"],
) -> float:
    """The least factor so that predicted values times it are upper bounds but for a fraction ``alpha``.

    Transitions of one trajectory are alike; only the K trajectories are exchangeable. So the factor is the
    least for which (1 + sum over trajectories of the fraction of each that exceeds its bound) / (K + 1) is at
    most alpha: conformal risk control (Angelopoulos et al. 2024). The promise is kept on average over sets of
    trajectories, for a transition of a trajectory drawn as these were: a planner chooses its own.

    Args:
        predicted: positive, of n transitions.
        true: what became of them.
        alpha: the rate.
        trajectory: numbers of their trajectories.

    Returns:
        the factor; infinite where no factor keeps the promise: accept nothing.

    Raises:
        ValueError: alpha is not between 0 and 1.
    """
    if not 0 < alpha < 1:
        raise ValueError(f"alpha is {alpha}, expected a rate between 0 and 1")
    _, index, sizes = np.unique(trajectory, return_inverse=True, return_counts=True)
    ratio = true / np.maximum(predicted, SMALLEST)
    order = np.argsort(-ratio, kind="stable")
    exceed = np.cumsum(1 / sizes[index[order]])
    # a factor equal to the k-th greatest ratio leaves those above it, k - 1 of them, exceeding
    risk = (1 + np.concatenate([[0.0], exceed[:-1]])) / (len(sizes) + 1)
    keeps = np.flatnonzero(risk <= alpha)
    return float(ratio[order[keeps[-1]]]) if keeps.size else float("inf")
