"""How varied augmentations are: how far from uniform in their transforms, and how far from originals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from doojax.datasets.store import Dataset
from doojax.types import Verdict

CELLS = 10  # of an axis's histogram
AT_MOST = 512  # augmentations, and originals, that are compared


@dataclass(frozen=True)
class Diversity:
    """Of a data set's augmentations."""

    drawn: float  # nats, `divergence` of what was aimed at
    accepted: float  # nats, of what came of it where that was accepted
    nearest: float  # m, the median distance of accepted examples to the nearest original


def divergence(transforms: Float[np.ndarray, "N D"], bounds: Float[np.ndarray, "D"]) -> float:
    """From uniform within ``bounds``, either way: Kullback and Leibler's, nats, mean over the axes that vary.

    Of histograms of ten cells: 0 is uniform, 2.3 all in one cell; N uniform transforms have some 4.5 / N.
    """
    found = []
    for axis in np.flatnonzero(bounds):
        share = np.clip(transforms[:, axis] / bounds[axis], -1.0, 1.0)
        counts, _ = np.histogram(share, CELLS, (-1.0, 1.0))
        part = counts[counts > 0] / counts.sum()
        found.append(float((part * np.log(part * CELLS)).sum()))
    return float(np.mean(found))


def nearest_distances(
    examples: Float[np.ndarray, "N ..."], originals: Float[np.ndarray, "M ..."]
) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"]]:
    """Of each example, the distance to the nearest of the originals, m, and its number.

    Root mean square over all points at all states, which are compared one by one.
    """
    points = [np.asarray(one, np.float64).reshape(len(one), -1) for one in (examples, originals)]
    squares = [(one**2).sum(1) for one in points]
    gaps = squares[0][:, None] + squares[1][None] - 2.0 * points[0] @ points[1].T
    nearest = gaps.argmin(1)
    exact = ((points[0] - points[1][nearest]) ** 2).sum(1)  # the product's rounding is not theirs
    return np.sqrt(exact * 3 / points[0].shape[1]), nearest


def diversity(dataset: Dataset) -> Diversity | None:
    """Of an augmented data set, of at most 512 augmentations and originals; None where none is accepted."""
    verdict, config = dataset["verdict"][:], dataset.config["augmentation"]
    targets = dataset["target"][:][verdict != Verdict.ORIGINAL]
    bounds = np.array([*config["translation"], *config["rotation"]]) * targets.any(0)  # some stay in a plane
    accepted = np.flatnonzero(verdict == Verdict.ACCEPTED)
    if not accepted.size:
        return None
    some, originals = (evenly(rows) for rows in (accepted, np.flatnonzero(verdict == Verdict.ORIGINAL)))
    gaps, _ = nearest_distances(positions(dataset, some), positions(dataset, originals))
    return Diversity(
        drawn=divergence(targets, bounds),
        accepted=divergence(dataset["transform"][:][accepted], bounds),
        nearest=float(np.median(gaps)),
    )


def positions(dataset: Dataset, rows: Int[np.ndarray, "N"]) -> Float[np.ndarray, "N T K 3"]:
    """Of all bodies in all states of some rows, m."""
    return np.asarray(dataset.states(rows).bodies())


def evenly(rows: Int[np.ndarray, "N"]) -> Int[np.ndarray, "K"]:
    """At most 512 of them, evenly spaced."""
    return rows[np.linspace(0, len(rows) - 1, min(AT_MOST, len(rows))).astype(int)]
