"""Minari's folder, read back through h5py and JSON."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

from doojax.datasets.exports import episodes_of
from doojax.datasets.exports.minari import box, write_minari

from .conftest import K, M, N, T


@pytest.fixture(scope="module")
def episodes(dataset):
    return episodes_of(dataset)


@pytest.fixture(scope="module")
def written(episodes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("minari")
    write_minari(episodes, folder, "known-v0")
    return folder / "data"


def test_every_episode_holds_its_trajectory_and_ends_by_being_cut_off(written, episodes, known):
    with h5py.File(written / "main_data.hdf5") as file:
        assert len(file) == K - 1
        for number, row in enumerate(episodes.trajectory):
            group = file[f"episode_{number}"]
            np.testing.assert_array_equal(group["observations/points"], known["points"][row])
            np.testing.assert_array_equal(group["observations/grippers"], known["grippers"][row])
            np.testing.assert_array_equal(group["actions"], known["actions"][row])
            centres = np.broadcast_to(known["obstacle_centre"][row], (T + 1, M, 3))
            np.testing.assert_array_equal(group["observations/obstacle_centre"], centres)
            np.testing.assert_array_equal(group["infos/clearance"], known["clearance"][row])
            assert group["infos/faults"][:].tolist() == [0, 0, 0, 4]
            assert group["truncations"][:].tolist() == [False, False, True]
            assert not group["terminations"][:].any() and not group["rewards"][:].any()
            np.testing.assert_allclose(group["infos/time_s"], np.arange(T + 1) * episodes.period)
            about = dict(group.attrs)
            assert (about["id"], about["total_steps"], about["trajectory"]) == (number, T, row)
            assert about["split"] == episodes.split_of(number)


def test_the_spaces_have_the_shapes_and_types_of_what_is_stored(written):
    metadata = json.loads((written / "metadata.json").read_text())
    assert (metadata["total_episodes"], metadata["total_steps"]) == (K - 1, (K - 1) * T)
    assert metadata["dataset_id"] == "known-v0"
    spaces = json.loads(metadata["observation_space"])["subspaces"]
    assert spaces["points"]["shape"] == [N, 3]
    with h5py.File(written / "main_data.hdf5") as file:
        seen = file["episode_0/observations"]
        assert set(seen) == set(spaces)
        for name, space in spaces.items():
            assert list(seen[name].shape[1:]) == space["shape"] and seen[name].dtype == space["dtype"]
            assert (np.array(space["low"]) <= seen[name]).all() and (
                seen[name] <= np.array(space["high"])
            ).all()
    assert json.loads(metadata["action_space"])["shape"] == [1, 3]
    about = metadata["doojax"]["fields"]
    assert about["points"]["unit"] == "m" and about["points"]["coordinates"][4] == "point1_y"


def test_a_space_is_bounded_where_its_numbers_are():
    assert box(np.zeros((2, 3, 2), bool)) == {
        **{"type": "Box", "dtype": "int8", "shape": [2]},
        **{"low": [0, 0], "high": [1, 1]},
    }
    assert box(np.zeros((2, 1), np.float32), varying=False)["high"] == [np.inf]
    assert box(np.zeros((2, 1), np.int32), varying=False)["low"] == [-(2**31)]


def test_a_scene_without_obstacles_is_seen_by_its_state_alone(episodes, tmp_path):
    bare = {name: episodes.arrays[name] for name in ("points", "grippers", "actions")}
    write_minari(replace(episodes, arrays=bare), tmp_path, "bare-v0")
    with h5py.File(tmp_path / "data/main_data.hdf5") as file:
        assert sorted(file["episode_9/observations"]) == ["grippers", "points"]
        assert list(file["episode_9/infos"]) == ["time_s"]
