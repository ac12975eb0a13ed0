"""How good an estimator of deviations is, on trajectories that it has not seen."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import spearmanr

from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import bootstrap
from doojax.experiments.reports.summary import row


class DeviationFigures(NamedTuple):
    """Of n predicted transitions; means are of the means of trajectories, which alone are independent."""

    error: Float[np.ndarray, "K"]  # mean absolute error (m) of each trajectory
    constant: Float[np.ndarray, "K"]  # the same, were always the middle deviation predicted
    rank_correlation: float  # Spearman's, of predicted and true
    covered: Mapping[float, Float[np.ndarray, "K"]]  # share that keeps the bound, by rate


def deviation_figures(
    predicted: Float[np.ndarray, "n"],
    true: Float[np.ndarray, "n"],
    trajectory: Int[np.ndarray, "n"],
    factors: Mapping[float, float],
) -> DeviationFigures:
    """Compare predicted and true deviations, m.

    Args:
        predicted: calibrated.
        true: what became of the same transitions.
        trajectory: numbers of their trajectories.
        factors: from the deviation to its upper bound, by the rate at which that may be exceeded.
    """
    _, index, sizes = np.unique(trajectory, return_inverse=True, return_counts=True)

    def by_trajectory(values: np.ndarray) -> np.ndarray:
        return np.bincount(index, weights=values.astype(float)) / sizes

    return DeviationFigures(
        error=by_trajectory(np.abs(predicted - true)),
        constant=by_trajectory(np.abs(np.median(true) - true)),
        rank_correlation=float(spearmanr(predicted, true)[0]),  # type: ignore[arg-type]
        covered={alpha: by_trajectory(true <= factor * predicted) for alpha, factor in factors.items()},
    )


def deviation_rows(figures: DeviationFigures, tags: dict[str, Any]) -> list[Row]:
    """`mde_error` (m), beside that of a constant; `mde_rank_correlation`; `mde_coverage` by rate."""
    rows = [row("mde_rank_correlation", tags, figures.rank_correlation, "", n=len(figures.error))]
    for name, values in (("network", figures.error), ("constant", figures.constant)):
        found = bootstrap(values)
        rows.append(
            row("mde_error", tags | {"estimate": name}, found.value, "m", found.low, found.high, found.n)
        )
    for alpha, values in figures.covered.items():
        found = bootstrap(values)
        named = tags | {"alpha": alpha}
        rows.append(row("mde_coverage", named, found.value, "", found.low, found.high, found.n))
    return rows
