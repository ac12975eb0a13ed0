"""The study of adaptation: its streams of random numbers, and its figures, by hand."""

import numpy as np
import pytest

from doojax.experiments.sweeps.adaptation import SHARES, adaptation_study, seed_of
from doojax.experiments.sweeps.adaptation_figures import Measured, draw_weights, study_rows
from doojax.experiments.training.deviation import deviation_figures, deviation_rows

THERE = np.array([[True, True], [True, False], [True, True]])
ALIKE = np.array([[True, False], [True, False], [False, False]])
TRAJECTORY = np.array([0, 0, 1])
FIGURES = deviation_figures(
    np.array([0.01, 0.02, 0.02, 0.05]),
    np.array([0.01, 0.03, 0.01, 0.05]),
    np.array([0, 0, 1, 1]),
    {0.1: 1.2},
)


def seed(focus, other):
    """One of the study's seeds; a method's errors are the same everywhere, in the rest ten times as large."""

    def errors(value):
        return np.where(THERE, np.where(ALIKE, value, 10 * value), np.nan)

    epochs = [
        {"validation_similar": [0.5], **{f"validation_weights_in_bin_{i}": [0.1] for i in range(10)}}
        for _ in range(3)
    ]
    return Measured(
        gamma=0.02,
        home=0.01,
        away=0.03,
        errors={"none": errors(other), "focus": errors(focus)},
        alike=ALIKE,
        there=THERE,
        trajectory=TRAJECTORY,
        epochs={"focus": epochs},
        deviation=FIGURES,
    )


SEEDS = [seed(0.010 + 0.001 * i, 0.020 + 0.0011 * i) for i in range(5)]


def values(rows, metric, **tags):
    return [row.value for row in rows if row.metric == metric and tags.items() <= row.tags.items()]


def test_errors_are_means_over_a_regions_steps():
    rows = study_rows("dual_gripper", {"stiff": SEEDS})
    assert values(rows, "dynamics_error_m", method="focus", region="similar") == [pytest.approx(0.012)]
    assert values(rows, "dynamics_error_m", method="focus", region="rest") == [pytest.approx(0.12)]
    assert values(rows, "source_error_ratio", pair="stiff") == [pytest.approx(3)]
    assert values(rows, "similar_share") == [pytest.approx(2 / 5)]  # of the steps that are there
    (less,) = values(rows, "error_reduction", against="none", region="similar")
    assert less == pytest.approx(np.mean([1 - one / two for one, two in zip(*by_seed(), strict=True)]))


def by_seed():
    return [[one.error(method, "similar") for one in SEEDS] for method in ("focus", "none")]


def test_focus_is_compared_with_every_other_method_over_seeds_and_over_trajectories():
    rows = study_rows("dual_gripper", {"stiff": SEEDS})
    over = {(row.tags["test"], row.n) for row in rows if row.metric == "p_value"}
    # the similar region has one trajectory, the rest two
    assert over == {("paired_t", 5), ("permutation", 5), ("signed_rank", 1), ("signed_rank", 2)}
    (p_value,) = values(rows, "p_value", test="permutation", region="similar")
    assert p_value == pytest.approx(2 / 32)  # the best that five pairs can show without more assumptions
    (p_value,) = values(rows, "p_value", test="paired_t", region="similar")
    assert p_value < 1e-6


def test_an_empty_region_is_said():
    one = SEEDS[0]._replace(alike=np.zeros_like(ALIKE))
    with pytest.raises(
        ValueError, match="no step of the mild rope's test trajectories is in the region 'sim"
    ):
        study_rows("dual_gripper", {"mild": [one]})


def test_deviations_by_hand():
    np.testing.assert_allclose(FIGURES.error, [0.005, 0.005])  # 0 and 1 cm, 1 cm and 0
    np.testing.assert_allclose(FIGURES.constant, [0.01, 0.02])  # the middle deviation is 2 cm
    np.testing.assert_allclose(FIGURES.covered[0.1], [0.5, 1.0])  # 3 cm exceeds 1.2 times 2 cm
    rows = deviation_rows(FIGURES, {})
    assert values(rows, "mde_error", estimate="network") == [pytest.approx(0.005)]
    assert values(rows, "mde_coverage", alpha=0.1) == [pytest.approx(0.75)]


def test_no_two_purposes_share_a_seed():
    names = [("source",)] + [
        (pair, name) for pair in ("stiff", "mild") for name in ("free", *SHARES, "set0", "set1")
    ]
    seeds = [seed_of(number, *name) for number in (0, 1) for name in names]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= one < 2**63 for one in seeds)


def test_weights_are_drawn(tmp_path):
    draw_weights(tmp_path / "weights.png", SEEDS, "dual_gripper, stiff rope")
    assert (tmp_path / "weights.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"pairs": ("long",)}, "pairs are long; expected some of stiff, mild"),
        ({"methods": ()}, "methods are ; expected some of focus"),
        ({"seeds": 0}, "seeds is 0, expected at least 1"),
    ],
)
def test_what_cannot_be_studied(options, complaint, tmp_path):
    with pytest.raises(ValueError, match=complaint):
        adaptation_study(out=tmp_path / "study", **options)
    assert not (tmp_path / "study").exists()
