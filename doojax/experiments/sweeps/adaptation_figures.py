"""Rows and pictures of `doojax.experiments.sweeps.adaptation`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure

from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import PairedTest, bootstrap, paired_t, permutation, signed_rank
from doojax.experiments.reports.summary import row
from doojax.experiments.training.deviation import DeviationFigures, deviation_rows
from doojax.experiments.training.pictures import save_figure
from doojax.learning.adaptation import BINS


class Measured(NamedTuple):
    """What one seed gave for one target rope; n test pieces of H steps."""

    gamma: float  # m
    home: float  # m, mean error of the source's model on the source's rope
    away: float  # m, on the target's rope, without obstacles
    errors: Mapping[str, Float[np.ndarray, "n H"]]  # m, by method; "none" is the source's model
    alike: Bool[np.ndarray, "n H"]  # which steps keep clear of obstacles
    there: Bool[np.ndarray, "n H"]
    trajectory: Int[np.ndarray, "n"]
    epochs: Mapping[str, list[dict[str, Any]]]  # what was logged, by method
    deviation: DeviationFigures

    def region(self, name: str) -> Bool[np.ndarray, "n H"]:
        """The steps of a region: similar, or rest."""
        return self.alike if name == "similar" else self.there & ~self.alike

    def error(self, method: str, region: str) -> float:
        """Mean error, m, of a method in a region; NaN where it is empty."""
        mask = self.region(region)
        return float(self.errors[method][mask].mean()) if mask.any() else float("nan")


REGIONS = ("similar", "rest")


def study_rows(task: str, found: Mapping[str, Sequence[Measured]]) -> list[Row]:
    """All figures: of each pair, method, region and epoch, with intervals over seeds, and paired tests.

    Raises:
        ValueError: a region of the test trajectories is empty.
    """
    rows = []
    for pair, seeds in found.items():
        tags = {"task": task, "pair": pair}
        for region in REGIONS:
            if not seeds[0].region(region).any():
                raise ValueError(
                    f"no step of the {pair} rope's test trajectories is in the region {region!r}: nothing to "
                    "compare; collect more, or another pair"
                )
        rows += _pair_rows(seeds, tags)
        for region in REGIONS:
            for method in seeds[0].errors:
                values = np.array([one.error(method, region) for one in seeds])
                named = tags | {"method": method, "region": region}
                rows.append(_row("dynamics_error_m", named, values, "m"))
            rows += _tests(seeds, region, tags)
        for method, epochs in seeds[0].epochs.items():
            for number in range(len(epochs)):
                if number + 1 in (1, 2, 5, 10, 20, len(epochs)):
                    share = [_logged(one.epochs[method][number], "similar") for one in seeds]
                    named = tags | {"method": method, "epoch": number + 1}
                    rows.append(_row("weight_share", named, np.array(share), ""))
        rows += deviation_rows(_pooled([one.deviation for one in seeds]), tags)
    return rows


def _pair_rows(seeds: Sequence[Measured], tags: dict[str, Any]) -> list[Row]:
    """How much worse the source's model is on the target's rope without obstacles; gamma; what is alike."""
    ratio = np.array([one.away / one.home for one in seeds])
    share = float(seeds[0].alike.sum() / seeds[0].there.sum())
    return [
        _row("source_error_m", tags | {"rope": "source"}, np.array([one.home for one in seeds]), "m"),
        _row("source_error_m", tags | {"rope": "target"}, np.array([one.away for one in seeds]), "m"),
        _row("source_error_ratio", tags, ratio, ""),
        _row("gamma_m", tags, np.array([one.gamma for one in seeds]), "m"),
        row("similar_share", tags, share, "", n=int(seeds[0].there.sum())),
    ]


def _tests(seeds: Sequence[Measured], region: str, tags: dict[str, Any]) -> list[Row]:
    """FOCUS against each other method: over seeds, and over test trajectories with seeds averaged."""
    if "focus" not in seeds[0].errors or len(seeds) < 2:
        return []
    rows = []
    for method in seeds[0].errors:
        if method == "focus":
            continue
        ours, theirs = ([one.error(name, region) for one in seeds] for name in ("focus", method))
        against = tags | {"against": method, "region": region}
        of_trajectories = [_by_trajectory(seeds, name, region) for name in ("focus", method)]
        tests: dict[str, tuple[PairedTest, int]] = {
            "paired_t": (paired_t(np.array(ours), np.array(theirs)), len(seeds)),
            "permutation": (permutation(np.array(ours), np.array(theirs)), len(seeds)),
            "signed_rank": (signed_rank(*of_trajectories), len(of_trajectories[0])),
        }
        for name, (found, count) in tests.items():
            over = "trajectories" if name == "signed_rank" else "seeds"
            rows.append(row("p_value", against | {"test": name, "over": over}, found.p_value, "", n=count))
        less = bootstrap(1 - np.array(ours) / np.array(theirs))
        rows.append(row("error_reduction", against, less.value, "", less.low, less.high, less.n))
    return rows


def _by_trajectory(seeds: Sequence[Measured], method: str, region: str) -> Float[np.ndarray, "K"]:
    """Mean error, m, of each test trajectory that has steps in a region, over seeds and those steps."""
    first = seeds[0]
    mask = first.region(region)
    mean = np.mean([np.where(mask, one.errors[method], 0.0) for one in seeds], axis=0).sum(1)
    total = np.bincount(first.trajectory, weights=mean)
    count = np.bincount(first.trajectory, weights=mask.sum(1).astype(float))
    return total[count > 0] / count[count > 0]


def _pooled(figures: Sequence[DeviationFigures]) -> DeviationFigures:
    """Means over seeds, of each trajectory."""
    return DeviationFigures(
        error=np.mean([one.error for one in figures], axis=0),
        constant=np.mean([one.constant for one in figures], axis=0),
        rank_correlation=float(np.mean([one.rank_correlation for one in figures])),
        covered={
            alpha: np.mean([one.covered[alpha] for one in figures], axis=0) for alpha in figures[0].covered
        },
    )


def _row(metric: str, tags: dict[str, Any], values: Float[np.ndarray, "s"], unit: str) -> Row:
    found = bootstrap(values)
    return row(metric, tags, found.value, unit, found.low, found.high, found.n)


def _logged(epoch: Mapping[str, Any], name: str) -> float:
    return float(np.mean(epoch[f"validation_{name}"]))


def draw_weights(out: Path, seeds: Sequence[Measured], title: str) -> None:
    """Histograms of FOCUS's weights by epoch, one behind the other as in the thesis's figure 4.5; beside
    them the share of transitions whose error is below gamma, by method."""
    figure = Figure(figsize=(9, 4), dpi=100, layout="constrained")
    left, right = figure.subplots(1, 2)
    method = "focus" if "focus" in seeds[0].epochs else next(iter(seeds[0].epochs))
    epochs = seeds[0].epochs[method]
    chosen = np.unique(np.linspace(0, len(epochs) - 1, 20).astype(int))
    edges = np.linspace(0, 1, BINS + 1)
    for place, number in reversed(list(enumerate(chosen))):
        share = [
            np.mean([_logged(one.epochs[method][number], f"weights_in_bin_{i}") for one in seeds])
            for i in range(BINS)
        ]
        base, colour = 0.1 * place, (place / len(chosen), 0.3, 1 - place / len(chosen))
        left.stairs(base + np.array(share), edges, baseline=base, fill=True, color=colour, alpha=0.6)
    left.set(xlabel="weight", ylabel="share of transitions, by epoch upwards", title=title, xlim=(0, 1))
    labels = [f"{number + 1}" for number in chosen[::4]]
    left.set_yticks([0.1 * place for place in range(0, len(chosen), 4)], labels)
    for name, logged in seeds[0].epochs.items():
        share = [
            np.mean([_logged(one.epochs[name][number], "similar") for one in seeds])
            for number in range(len(logged))
        ]
        right.plot(np.arange(1, len(share) + 1), share, label=name.replace("_", " "))
    right.set(xlabel="epoch", ylabel="share of transitions with an error below gamma", ylim=(0, 1))
    right.legend()
    save_figure(figure, out)
