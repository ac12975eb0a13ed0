"""Own trajectories become data sets that are learned from like others."""

import csv

import numpy as np
import pytest

from doojax.datasets import Dataset
from doojax.datasets.imports.command import import_trajectories
from doojax.datasets.imports.files import read_csv
from doojax.learning.data import load_split
from doojax.types import ShapeKind

K, T, N = 12, 3, 5  # the toy's rope


@pytest.fixture
def recorded():
    """Straight ropes that move by 1 cm a step along y, gripper ahead of the last point."""
    x = np.arange(N + 1) * 0.05
    still = np.stack([x, np.zeros(N + 1), np.zeros(N + 1)], -1)
    moves = np.arange(T + 1)[:, None, None] * np.array([0.0, 0.01, 0.0])
    every = np.broadcast_to(still + moves, (K, T + 1, N + 1, 3)) + np.arange(K)[:, None, None, None] * 0.001
    return {"points": every[:, :, :N], "grippers": every[:, :, N:]}


def as_csv(path, recorded):
    names = [f"point{i}_{a}" for i in range(N) for a in "xyz"] + [f"gripper0_{a}" for a in "xyz"]
    with path.open("w") as file:
        writer = csv.writer(file)
        writer.writerow(["trajectory", "step", *names])
        for k in range(K):
            for t in reversed(range(T + 1)):  # in any order
                values = np.concatenate([recorded["points"][k, t], recorded["grippers"][k, t]])
                writer.writerow([f"run{k}", t, *map(repr, values.reshape(-1).tolist())])


def test_both_kinds_of_file_give_what_was_recorded(tmp_path, recorded, capsys):
    np.savez(tmp_path / "mine.npz", **recorded)
    as_csv(tmp_path / "mine.csv", recorded)
    for ending in ("npz", "csv"):
        import_trajectories(tmp_path / f"mine.{ending}", task="toy", out=tmp_path / ending)
        dataset = Dataset.open(tmp_path / ending)
        dataset.verify()
        np.testing.assert_array_equal(dataset["points"][:], recorded["points"].astype(np.float32))
        np.testing.assert_allclose(dataset["actions"][:], np.tile([0.0, 0.01, 0.0], (K, T, 1, 1)), atol=1e-7)
        data = load_split(dataset, "train")
        assert len(data) == 8 and not data.obstacles.active.any()
    assert "their ropes are 0.25 m long, that of toy 0.25 m" in capsys.readouterr().err


def test_obstacles_come_along_and_say_how_near_they_were(tmp_path, recorded):
    box = {
        "obstacle_kind": np.full((K, 1), ShapeKind.BOX),
        "obstacle_centre": np.tile([0.0, 0.5, 0.0], (K, 1, 1)),
        "obstacle_quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (K, 1, 1)),
        "obstacle_half_size": np.full((K, 1, 3), 0.1),
        "obstacle_active": np.ones((K, 1), bool),
    }
    np.savez(tmp_path / "mine.npz", **recorded, **box)
    import_trajectories(tmp_path / "mine.npz", task="toy", phase="constrained", out=tmp_path / "out")
    dataset = Dataset.open(tmp_path / "out")
    radius = 0.4 - np.asarray(dataset["clearance"][0])  # 40 cm from the axis of the first rope to the box
    np.testing.assert_allclose(radius - radius[0], 0.01 * np.arange(T + 1), atol=1e-6)
    assert bool(dataset.obstacles(np.arange(K)).active.all())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": None}, "lacks points"),
        ({"points": np.zeros((K, T + 1, 7, 3))}, r"points has the shape \[12, 4, 7, 3\].* \[12, 4, 5, 3\]"),
        ({"points": np.zeros((K, 1, N, 3))}, "with T at least 1"),
        ({"grippers": np.full((K, T + 1, 1, 3), np.nan)}, "grippers .* not finite"),
        ({"velocities": np.zeros(3)}, "holds velocities: expected points, grippers, actions"),
        ({"obstacle_kind": np.zeros((K, 1))}, "expected all of them, or none"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, recorded, change, message):
    arrays = {name: values for name, values in {**recorded, **change}.items() if values is not None}
    np.savez(tmp_path / "mine.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        import_trajectories(tmp_path / "mine.npz", task="toy", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_constrained_data_need_their_obstacles(tmp_path, recorded):
    np.savez(tmp_path / "mine.npz", **recorded)
    with pytest.raises(ValueError, match="no obstacles, which phase constrained needs"):
        import_trajectories(tmp_path / "mine.npz", task="toy", phase="constrained", out=tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "lacks the columns trajectory, step"),
        ("trajectory,step\n0,0\n", "lacks the columns of points or grippers"),
        ("trajectory,step,point0_x,point0_y,point0_z,gripper0_x\n", "gripper0_y, gripper0_z"),
        (
            "trajectory,step,point0_x,point0_y,point0_z,gripper0_x,gripper0_y,gripper0_z\n0,0,0,0,x,0,0,0\n",
            "line 2: could not convert string to float: 'x'",
        ),
        (
            "trajectory,step,point0_x,point0_y,point0_z,gripper0_x,gripper0_y,gripper0_z\n"
            + "0,0,0,0,0,0,0,0\n0,1,0,0,0,0,0,0\n1,0,0,0,0,0,0,0\n",
            r"trajectories of \[1, 2\] states",
        ),
    ],
)
def test_a_table_that_cannot_be_read_is_refused(tmp_path, text, message):
    (tmp_path / "mine.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_csv(tmp_path / "mine.csv")
