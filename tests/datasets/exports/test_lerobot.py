"""LeRobot's folder, read back through pyarrow and JSON: every number where its layout wants it."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pyarrow
import pyarrow.parquet as parquet
import pytest

from doojax.datasets.exports import episodes_of, lerobot
from doojax.datasets.exports.lerobot import statistics, write_lerobot

from .conftest import K, M, N, T


@pytest.fixture(scope="module")
def episodes(dataset):
    return episodes_of(dataset)


@pytest.fixture(scope="module")
def written(episodes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("lerobot")
    write_lerobot(episodes, folder)
    return folder


@pytest.fixture(scope="module")
def info(written):
    return json.loads((written / "meta/info.json").read_text())


@pytest.fixture(scope="module")
def table(written):
    return parquet.read_table(written / "data/chunk-000/file-000.parquet")


def column(table, name):
    return np.array(table[name].to_pylist())


def test_frames_hold_states_actions_and_where_they_led(table, episodes, known):
    rows = episodes.trajectory
    states = np.concatenate([known["points"], known["grippers"]], axis=2)[rows].reshape(K - 1, T + 1, -1)
    np.testing.assert_array_equal(column(table, "observation.state"), states[:, :-1].reshape(-1, 3 * N + 3))
    np.testing.assert_array_equal(
        column(table, "next.observation.state"), states[:, 1:].reshape(-1, 3 * N + 3)
    )
    np.testing.assert_array_equal(column(table, "action"), known["actions"][rows].reshape(-1, 3))
    clearance = known["clearance"][rows, :-1].reshape(-1)
    np.testing.assert_array_equal(column(table, "observation.clearance"), clearance)
    assert column(table, "next.faults").tolist() == [0, 0, 4] * (K - 1)
    second = rows[0] * 1000 + 10.0  # of the first episode's second state, by the rule of these numbers
    assert table["observation.state"][1].as_py()[:2] == pytest.approx([second, second + 0.01])


def test_obstacles_are_the_same_in_every_frame_of_an_episode(table, info, known, episodes):
    names = info["features"]["observation.environment_state"]["names"]
    assert len(names) == M * (1 + 3 + 4 + 3 + 1)
    every = column(table, "observation.environment_state").reshape(K - 1, T, -1)
    assert (every == every[:, :1]).all()
    at = names.index("obstacle_centre1_y")
    np.testing.assert_array_equal(every[:, 0, at], known["obstacle_centre"][episodes.trajectory, 1, 1])
    assert every[0, 0, names.index("obstacle_active1")] == 0


def test_time_and_numbers_count_as_lerobot_does(table, info, episodes):
    assert column(table, "frame_index").tolist() == [0, 1, 2] * (K - 1)
    assert column(table, "episode_index").tolist() == [k for k in range(K - 1) for _ in range(T)]
    assert column(table, "index").tolist() == list(range((K - 1) * T))
    assert column(table, "next.done").tolist() == [False, False, True] * (K - 1)
    seconds = column(table, "frame_index") * episodes.period
    np.testing.assert_allclose(column(table, "timestamp"), seconds, rtol=1e-6)
    assert info["fps"] * episodes.period == pytest.approx(1)


def test_info_describes_every_column_by_type_shape_names_and_units(table, info, dataset):
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (K - 1, (K - 1) * T, 1)
    assert list(info["features"]) == table.column_names
    for name, feature in info["features"].items():
        (size,) = feature["shape"]
        assert len(feature["names"]) == len(feature["info"]["units"]) == size
        kind = table.schema.field(name).type
        assert (kind if size == 1 else kind.value_type) == pyarrow.from_numpy_dtype(feature["dtype"])
        assert size == 1 or kind.list_size == size
    state = info["features"]["observation.state"]
    assert state["names"][:4] == ["point0_x", "point0_y", "point0_z", "point1_x"]
    assert state["names"][-1] == "gripper0_z" and set(state["info"]["units"]) == {"m"}
    ends = [part.split(":") for part in info["splits"].values()]
    assert ends[0][0] == "0" and ends[-1][1] == str(K - 1)
    assert all(before[1] == after[0] for before, after in pairwise(ends))
    assert list(info["splits"]) == [name for name in info["splits"] if len(dataset.split(name))]


def test_episodes_say_where_they_are_and_what_they_were(written, episodes):
    rows = parquet.read_table(written / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["length"] for row in rows] == [T] * (K - 1)
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows[:2]] == [(0, 3), (3, 6)]
    assert [row["trajectory"] for row in rows] == episodes.trajectory.tolist()
    assert rows[0]["split"] == "train" and rows[0]["tasks"] == [episodes.text]
    first = rows[0]["trajectory"] * 1000
    assert rows[0]["stats/action/max"] == pytest.approx([first + 20, first + 20.01, first + 20.02])
    tasks = parquet.read_table(written / "meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "toy: random actions"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_figures_are_those_of_a_column_worked_by_hand(written):
    found = statistics(np.arange(5.0).reshape(1, 5, 1))
    expected = {"min": 0, "max": 4, "mean": 2, "std": 2**0.5, "count": 5, "q50": 2}
    expected |= {"q01": 0.04, "q10": 0.4, "q90": 3.6, "q99": 3.96}
    assert {name: value for name, (value,) in found.items()} == pytest.approx(expected)
    stats = json.loads((written / "meta/stats.json").read_text())
    assert stats["frame_index"]["mean"] == [1.0]
    assert stats["observation.state"]["count"] == [(K - 1) * T]


def test_a_large_set_is_cut_into_files_between_episodes(episodes, tmp_path, monkeypatch):
    each = sum(column.values[0].nbytes for column in lerobot.columns_of(episodes).values())
    monkeypatch.setattr(lerobot, "BYTES_IN_FILE", 4 * each)
    monkeypatch.setattr(lerobot, "FILES_IN_CHUNK", 2)
    write_lerobot(episodes, tmp_path)
    files = sorted(str(file.relative_to(tmp_path / "data")) for file in tmp_path.glob("data/*/*"))
    assert files == ["chunk-000/file-000.parquet", "chunk-000/file-001.parquet", "chunk-001/file-000.parquet"]
    last = parquet.read_table(tmp_path / "data" / files[-1])
    assert set(last["episode_index"].to_pylist()) == {8, 9}
    rows = parquet.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["data/chunk_index"], row["data/file_index"]) for row in rows[3:5]] == [(0, 0), (0, 1)]
    assert (rows[9]["data/chunk_index"], rows[9]["data/file_index"]) == (1, 0)


def test_a_scene_without_obstacles_has_no_state_of_its_surroundings(episodes):
    bare = {name: episodes.arrays[name] for name in ("points", "grippers", "actions")}
    found = lerobot.columns_of(replace(episodes, arrays=bare))
    assert list(found)[:4] == ["observation.state", "action", "next.observation.state", "next.done"]
