"""What was exported comes back, what others made comes in by its names, what is wrong is refused."""

import json
import shutil

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest

from doojax.cli import main
from doojax.datasets import Dataset
from doojax.datasets.collect import command_of
from doojax.datasets.exports.command import Layout, export
from doojax.datasets.imports import trajectories
from doojax.datasets.imports.command import import_trajectories

from .conftest import UNSTABLE, K, N, T

LAYOUTS: dict[Layout, str] = {"lerobot": "known", "minari": "known-v0"}


@pytest.fixture(scope="module")
def exported(folder, tmp_path_factory):
    """The known data set in both layouts."""
    found = {}
    for layout, name in LAYOUTS.items():
        found[layout] = tmp_path_factory.mktemp(layout) / name
        export(folder, format=layout, out=found[layout])
    return found


@pytest.fixture
def copied(exported, tmp_path):
    """A copy of one layout's folder, to be spoilt."""

    def copy(layout):
        return shutil.copytree(exported[layout], tmp_path / layout / exported[layout].name)

    return copy


@pytest.fixture
def no_obstacles(monkeypatch):
    """Nothing is compiled to find out how near they were."""
    monkeypatch.setattr(trajectories, "_clearance", lambda _, __, points, ___: np.zeros(points.shape[:2]))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_was_exported_comes_back_but_for_what_only_a_replay_needs(
    layout, exported, dataset, tmp_path, capsys
):
    arguments = ["import", str(exported[layout]), "--format", layout, "--out", str(tmp_path / "back")]
    assert main(arguments) == 0
    said = capsys.readouterr().err
    assert "not exported, and so not here: initial_qpos (for doojax replay)" in said
    assert "trajectories without values were not exported: 1" in said
    back = Dataset.open(tmp_path / "back")
    back.verify()
    assert back.fields == {name: field for name, field in dataset.fields.items() if name != "initial_qpos"}
    sound = [row for row in range(K) if row != UNSTABLE]
    for name in back.fields:
        np.testing.assert_array_equal(back[name][:], dataset[name][sound], strict=True, err_msg=name)
    about = back.config.pop("imported")
    assert back.config == dataset.config | {"stream": back.config["stream"]}
    assert about["format"] == layout and about["versions"] == dataset.manifest.versions
    assert command_of(back.manifest, tmp_path / "again") is None


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_second_export_of_what_came_back_has_the_same_numbers(layout, exported, tmp_path):
    import_trajectories(exported[layout], format=layout, out=tmp_path / "back")
    again = tmp_path / exported[layout].name
    export(tmp_path / "back", format=layout, out=again)
    place = "data/main_data.hdf5" if layout == "minari" else "meta/info.json"
    assert (again / place).exists()
    import_trajectories(again, format=layout, out=tmp_path / "twice")
    once, twice = Dataset.open(tmp_path / "back"), Dataset.open(tmp_path / "twice")
    assert once.fields == twice.fields
    for name in once.fields:
        np.testing.assert_array_equal(once[name][:], twice[name][:])


@pytest.mark.parametrize("next_too", [False, True])
def test_lerobots_of_others_come_in_by_the_names_of_their_numbers(
    next_too, tmp_path, known, capsys, no_obstacles
):
    """Without word of where the last action led, the last frame is the last state, and has no action."""
    states = np.concatenate([known["points"], known["grippers"]], 2)[:UNSTABLE].reshape(UNSTABLE, T + 1, -1)
    names = [f"point{i}_{a}" for i in range(N) for a in "xyz"] + [f"gripper0_{a}" for a in "xyz"]
    moves = np.array([f"action0_{a}" for a in "xyz"])
    frames = T if next_too else T + 1
    actions = np.arange(UNSTABLE * frames * 3, dtype=np.float32).reshape(UNSTABLE, frames, 3)
    features = {
        "observation.images.cam": {"dtype": "video", "shape": [4, 4, 3], "names": ["h", "w", "c"]},
        "observation.state": {"dtype": "float32", "shape": [len(names)], "names": {"axes": names[::-1]}},
        "action": {"dtype": "float32", "shape": [3], "names": list(moves)},
    }
    columns = {"observation.state": states[:, :frames, ::-1], "action": actions}
    if next_too:
        features["next.observation.state"] = features["observation.state"] | {"names": names}
        columns["next.observation.state"] = states[:, 1:]
    table = {name: pa.array(list(values.reshape(UNSTABLE * frames, -1))) for name, values in columns.items()}
    table["episode_index"] = np.repeat(np.arange(UNSTABLE), frames)
    table["frame_index"] = np.tile(np.arange(frames), UNSTABLE)
    for part in ("meta", "data/chunk-000"):
        (tmp_path / "hub" / part).mkdir(parents=True)
    info = {"codebase_version": "v3.0", "total_episodes": UNSTABLE, "features": features}
    (tmp_path / "hub/meta/info.json").write_text(json.dumps(info))
    parquet.write_table(pa.table(table), tmp_path / "hub/data/chunk-000/file-000.parquet")
    import_trajectories(tmp_path / "hub", format="lerobot", task="toy", out=tmp_path / "out")
    back = Dataset.open(tmp_path / "out")
    np.testing.assert_array_equal(back["points"][:], known["points"][:UNSTABLE])
    np.testing.assert_array_equal(back["grippers"][:], known["grippers"][:UNSTABLE])
    np.testing.assert_array_equal(back["actions"][:], actions[:, :T, None])
    assert back.config["task"] == "toy" and "m long, that of toy" in capsys.readouterr().err
    with pytest.raises(ValueError, match="does not say what its rope and hands are: say --task"):
        import_trajectories(tmp_path / "hub", format="lerobot", out=tmp_path / "none")


def test_minaris_of_others_come_in_by_the_names_of_their_observations(tmp_path, known, no_obstacles):
    (tmp_path / "mine-v0/data").mkdir(parents=True)
    metadata = {"data_format": "hdf5", "minari_version": "0.5.3", "total_episodes": 2}
    (tmp_path / "mine-v0/data/metadata.json").write_text(json.dumps(metadata))
    with h5py.File(tmp_path / "mine-v0/data/main_data.hdf5", "w") as file:
        for number in range(2):
            for name in ("points", "grippers"):
                file[f"episode_{number}/observations/{name}"] = known[name][number]
            file[f"episode_{number}/actions"] = known["actions"][number]
    import_trajectories(tmp_path / "mine-v0", format="minari", task="toy", out=tmp_path / "out")
    back = Dataset.open(tmp_path / "out")
    for name in ("points", "grippers", "actions"):
        np.testing.assert_array_equal(back[name][:], known[name][:2])
    assert back["environment"][:].tolist() == [0, 1]


def changed_json(file, **changes):
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def rewritten(folder, name, change, of="data"):
    """A column of Parquet files, changed."""
    (file,) = (folder / of).glob("*/*.parquet")
    table = parquet.read_table(file)
    column = change(table[name].to_pylist())
    at = table.column_names.index(name)
    table = table.remove_column(at) if column is None else table.set_column(at, name, pa.array(column))
    parquet.write_table(table, file)


def nan_in(values):
    values[0][0] = float("nan")
    return values


def info(**changes):
    return lambda folder: changed_json(folder / "meta/info.json", **changes)


def metadata(**changes):
    return lambda folder: changed_json(folder / "data/metadata.json", **changes)


def frames(name, change, of="data"):
    return lambda folder: rewritten(folder, name, change, of)


def numbers(name, change):
    return lambda folder: stored(folder, name, change)


LEROBOT = {
    "layout": (
        info(codebase_version="v2.1"),
        r"layout 'v2.1', expected",
    ),
    "features": (info(features=None), "lists no features"),
    "names": (
        info(features={}),
        "has no point0_x, .* among the names",
    ),
    "count": (info(total_episodes=9), "has 9 episodes, and has 10"),
    "frames": (info(total_frames=9), "has 9 frames, and has 30"),
    "column": (frames("action", lambda _: None), "lack the column action"),
    "nan": (frames("action", nan_in), "actions has values that are not finite"),
    "null": (
        frames("action", lambda v: [None, *v[1:]]),
        "action has 1 frames without a value",
    ),
    "short": (frames("episode_index", lambda v: [0, *v[1:-1], 8]), r"episode 8 has 4"),
    "order": (frames("frame_index", lambda v: [9, *v[1:]]), "frame_index does not count"),
    "led": (
        frames("next.observation.state", lambda v: [v[1], *v[1:]]),
        "frame 0 of episode 0 led",
    ),
    "moves": (
        frames("observation.environment_state", lambda v: [v[3], *v[1:]]),
        "changes within episode 0, but obstacles stand still",
    ),
    "episodes": (
        frames("split", lambda _: None, "meta/episodes"),
        "meta/episodes lack split",
    ),
    "length": (
        frames("length", lambda v: [9, *v[1:]], "meta/episodes"),
        "count other episodes",
    ),
    "about": (lambda f: (f / "meta/doojax.json").write_text("{}"), "does not say of doojax's export"),
    "no data": (lambda f: shutil.rmtree(f / "data"), "has no Parquet file below data"),
    "damaged": (
        lambda f: (f / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1 nothing"),
        "Parquet file below .* cannot be read",
    ),
    "no info": (
        lambda f: (f / "meta/info.json").unlink(),
        "no data set of LeRobot: it has no meta/info.json",
    ),
}


def stored(folder, name, change):
    """A dataset of the HDF5 file, changed."""
    with h5py.File(folder / "data/main_data.hdf5", "r+") as file:
        values = change(np.asarray(file[name]))
        del file[name]
        if values is not None:
            file[name] = values


MINARI = {
    "layout": (metadata(data_format="arrow"), "is 'arrow': expected"),
    "version": (
        metadata(minari_version="0.4.3"),
        "Minari 0.4.3: expected",
    ),
    "count": (
        metadata(total_episodes=9),
        "has 9 episodes, and has 10",
    ),
    "steps": (
        metadata(total_steps=9),
        "9 steps, and has 10 episodes of 3",
    ),
    "missing": (
        numbers("episode_2/observations/points", lambda _: None),
        "no observations/points",
    ),
    "shape": (
        numbers("episode_2/observations/points", lambda v: v[:, :2]),
        r"points of episode_2 has the shape \(4, 2, 3\), not \(4, 5, 3\)",
    ),
    "short": (numbers("episode_2/actions", lambda v: v[:1]), r"episode 2 has 1, episode 0 has 3"),
    "nan": (
        numbers("episode_2/actions", lambda v: v * np.nan),
        "actions has values that are not",
    ),
    "moves": (
        lambda f: stored(
            f, "episode_0/observations/obstacle_centre", lambda v: v * np.arange(4)[:, None, None]
        ),
        "obstacle_centre changes within episode",
    ),
    "damaged": (
        lambda f: (f / "data/main_data.hdf5").write_bytes(b"nothing"),
        "main_data.hdf5 cannot be read",
    ),
    "no data": (lambda f: (f / "data/main_data.hdf5").unlink(), "lacks data/main_data.hdf5"),
    "no word": (lambda f: (f / "data/metadata.json").unlink(), "it has no data/metadata.json, but data/"),
}


WRONG = {"lerobot": LEROBOT, "minari": MINARI}


@pytest.mark.parametrize(("layout", "case"), [(layout, case) for layout in WRONG for case in WRONG[layout]])
def test_what_is_wrong_with_a_folder_is_said(layout, case, copied, tmp_path):
    spoil, message = WRONG[layout][case]
    folder = copied(layout)
    spoil(folder)
    with pytest.raises(ValueError, match=message):
        import_trajectories(folder, format=layout, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_was_meant_otherwise_is_refused(layout, exported, tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        import_trajectories(tmp_path / "none", format=layout, out=tmp_path / "out")
    with pytest.raises(ValueError, match="has data of the task 'toy', not 'rope_dragging': leave --task out"):
        import_trajectories(exported[layout], format=layout, task="rope_dragging", out=tmp_path / "out")
    with pytest.raises(ValueError, match="is a folder: say --format lerobot or --format minari"):
        import_trajectories(exported[layout], out=tmp_path / "out")
