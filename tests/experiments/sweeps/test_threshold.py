"""A sweep over thresholds on the toy task, and its figures by hand."""

import csv

import equinox as eqx
import jax
import numpy as np
import pytest

from doojax.datasets.collect import collect
from doojax.experiments.reports.summary import read_summary
from doojax.experiments.sweeps.threshold import sweep_rows, sweep_threshold
from doojax.learning.checkpoints import Header, save_model
from doojax.learning.data import load_split, open_dataset
from doojax.learning.labels import LabelConfig, label
from doojax.learning.sweep import Measured, judge
from doojax.models.builders import dynamics as build

DYNAMICS = {"points": 5, "grippers": 1, "origin": "gripper", "width": 8, "members": 2}
THRESHOLDS = (0.06, 0.03)


@pytest.fixture(scope="session")
def toy(tmp_path_factory):
    """Constrained data, and dynamics that say: the rope moves as its gripper does not."""
    folder = tmp_path_factory.mktemp("sweep")
    collect("toy", phase="constrained", trajectories=384, states=6, out=folder / "data")
    still = build(DYNAMICS)
    network = jax.tree.map(
        lambda leaf: 0 * leaf if eqx.is_inexact_array(leaf) else leaf, still.members.network
    )
    still = eqx.tree_at(lambda model: model.members.network, still, network)
    header = Header("dynamics", "toy", DYNAMICS, {"threshold_m": 0.04})
    save_model(folder / "model.eqx", header, still)
    return folder / "data", folder / "model.eqx", still


@pytest.mark.slow
def test_every_threshold_and_seed_is_a_member_with_labels_of_its_own(toy, tmp_path):
    data, dynamics, still = toy
    sweep_threshold(
        data=data,
        dynamics=dynamics,
        out=tmp_path / "sweep",
        thresholds=THRESHOLDS,
        seeds=2,
        epochs=2,
        publish=tmp_path,
    )
    with (tmp_path / "sweep" / "sweep.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [(float(line["threshold_m"]), line["seed"]) for line in lines] == [
        (pytest.approx(threshold), seed) for threshold in sorted(THRESHOLDS) for seed in "01"
    ]
    examples = label(still, load_split(open_dataset(data), "test"), LabelConfig())
    for line in lines:
        threshold = np.float32(line["threshold_m"])
        kept = np.asarray(examples.error_before) < threshold
        right = np.asarray(examples.error)[kept] < threshold
        assert int(line["transitions"]) == kept.sum()
        assert float(line["right_fraction"]) == pytest.approx(right.mean())
        assert float(line["auroc"]) > 0.6  # how far the gripper goes says a lot
    assert lines[0]["auroc"] != lines[1]["auroc"]  # seeds differ
    assert (tmp_path / "sweep" / "sweep.png").read_bytes().startswith(b"\x89PNG")
    rows = {(row.metric, row.tags["times_own"]): row for row in read_summary(tmp_path / "summary.json").rows}
    assert rows["threshold_sweep_threshold_m", 1.5].value == pytest.approx(0.06)
    mean = np.mean([float(line["auroc"]) for line in lines[2:]])
    assert rows["threshold_sweep_auroc", 1.5].value == pytest.approx(mean)


def test_figures_of_four_transitions():
    found = judge(np.array([0.9, 0.6, 0.7, 0.2]), np.array([True, True, False, False]), 0.01, 0)
    expected = Measured(0.01, 0, 4, 0.5, accuracy=0.75, precision=2 / 3, recall=1.0, auroc=0.75)
    assert found == expected


def test_an_interval_over_three_seeds():
    some = [Measured(0.02, seed, 9, 0.5, 0.8 + 0.01 * seed, 0.5, 0.5, 0.5) for seed in range(3)]
    rows = {row.metric: row for row in sweep_rows(some, {"task": "toy"}, 0.04)}
    accuracy = rows["threshold_sweep_accuracy"]
    assert accuracy.tags["times_own"] == 0.5
    assert accuracy.value == pytest.approx(0.81)
    assert accuracy.high == pytest.approx(0.81 + 4.302653 * 0.01 / 3**0.5)  # Student's t, 2 degrees


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"thresholds": (0.02, 0.02)}, r"thresholds are \[0.02, 0.02\], expected different positive lengths"),
        ({"thresholds": (0.02, -1.0)}, "expected different positive lengths"),
        ({"seeds": 0}, "seeds is 0, expected at least 1"),
        pytest.param(
            {"thresholds": (0.03, 9.0)},
            "train split has 0 wrong predictions at a threshold of 9 m",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_what_cannot_be_swept_leaves_nothing_behind(toy, tmp_path, options, message):
    data, dynamics, _ = toy
    with pytest.raises(ValueError, match=message):
        sweep_threshold(data=data, dynamics=dynamics, out=tmp_path / "sweep", publish=tmp_path, **options)
    assert list(tmp_path.iterdir()) == []
