"""What benches report of repeated timings: medians, with intervals that assume no distribution."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import row


def median_with_interval(samples: Float[np.ndarray, "n"]) -> tuple[float, float, float]:
    """Median and its 95 % interval, from the ranks that a binomial count of samples below it allows."""
    ordered, half = np.sort(samples), 0.98 * len(samples) ** 0.5
    low, high = int(len(samples) / 2 - half), int(np.ceil(len(samples) / 2 + half))
    return float(np.median(ordered)), float(ordered[max(low, 0)]), float(ordered[min(high, len(samples) - 1)])


def median_row(metric: str, tags: Mapping[str, Any], samples: Float[np.ndarray, "n"], unit: str) -> Row:
    """`median_with_interval` as a row of a summary."""
    median, low, high = median_with_interval(samples)
    return row(metric, dict(tags), median, unit, low, high, len(samples))
