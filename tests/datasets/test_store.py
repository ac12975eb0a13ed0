import json
import time

import jax
import numpy as np
import pytest
import zarr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from doojax.datasets import Dataset, Field
from doojax.datasets.splits import split_by_environment

from .example_collection import CONFIG, SCHEMA, collect, folder_bytes, open_writer, shard_arrays

TRAJECTORIES = 23  # in 5 shards of 5, the last of 3


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    path = tmp_path_factory.mktemp("complete") / "data"
    return path, collect(path)


@pytest.fixture(scope="module")
def gappy(tmp_path_factory):
    """A data set of which shards 0, 2 and 4 are complete."""
    path = tmp_path_factory.mktemp("gappy") / "data"
    arrays = collect(path, shards=[4, 0, 2])
    rows = np.r_[0:5, 10:15, 20:23]
    return path, {name: values[rows] for name, values in arrays.items()}


def open_unfinished(path):
    with pytest.warns(UserWarning, match="is unfinished"):
        return Dataset.open(path)


def test_everything_written_is_read(stored):
    path, arrays = stored
    dataset = Dataset.open(path)
    assert dataset.complete
    assert len(dataset) == TRAJECTORIES
    assert dataset.fields == SCHEMA
    assert dataset.config == CONFIG
    for name, values in arrays.items():
        read = dataset[name][:]
        assert read.dtype == values.dtype
        np.testing.assert_array_equal(read, values)
        np.testing.assert_array_equal(np.asarray(dataset[name]), values)
    dataset.verify()
    assert repr(dataset).startswith(f"Dataset({str(path)!r}: 23 trajectories; points, grippers")
    assert repr(dataset["points"]) == "points: float32 [23, 7, 4, 3], m: points along the rope"


def test_plain_zarr_reads_it_without_warnings(stored):
    path, arrays = stored
    group = zarr.open(path, mode="r")
    assert isinstance(group, zarr.Group)
    assert {name for name, _ in group.members()} == set(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(np.asarray(group[name]), values)
        assert group[name].attrs["unit"] == SCHEMA[name].unit


bounds = st.none() | st.integers(-30, 30)
indices = (
    st.builds(slice, bounds, bounds, st.none() | st.integers(-7, 7).filter(bool))
    | st.integers(-13, 12)
    | hnp.arrays(
        np.int64, hnp.array_shapes(max_dims=2, min_side=0, max_side=9), elements=st.integers(-13, 12)
    )
    | st.lists(st.integers(0, 12), max_size=5)
)


def test_indexing_is_numpys(stored, gappy):
    complete, unfinished = Dataset.open(stored[0]), open_unfinished(gappy[0])

    @given(index=indices)
    def check(index):
        for dataset, arrays in ((complete, stored[1]), (unfinished, gappy[1])):
            for name in ("points", "environment"):
                expected = arrays[name][np.asarray(index, dtype=int) if isinstance(index, list) else index]
                read = dataset[name][index]
                assert read.shape == expected.shape
                np.testing.assert_array_equal(read, expected)

    check()


def test_masks_and_bad_indices(stored):
    path, arrays = stored
    points = Dataset.open(path)["points"]
    mask = arrays["environment"] % 3 == 0
    np.testing.assert_array_equal(points[mask], arrays["points"][mask])
    with pytest.raises(IndexError, match="23 is out of bounds"):
        points[23]
    with pytest.raises(IndexError, match=r"only trajectories can be indexed"):
        points[3, 1]
    with pytest.raises(KeyError, match="no field 'velocity', only points, grippers"):
        Dataset.open(path)["velocity"]


def test_only_needed_chunks_are_read(tmp_path):
    arrays = collect(tmp_path)
    for name in SCHEMA:
        for file in (tmp_path / name).glob("c.*"):
            if file.name.split(".")[1] != "3":
                file.unlink()
    dataset = Dataset.open(tmp_path)
    np.testing.assert_array_equal(dataset["points"][15:20], arrays["points"][15:20])
    with pytest.raises(ValueError, match=r"shard 2, field 'points': .*c\.2\.0\.0\.0 cannot be read"):
        dataset["points"][14:20]


def test_unfinished_shows_complete_shards_only(gappy):
    path, arrays = gappy
    with pytest.warns(UserWarning, match="is unfinished: 13 of 23 trajectories; the same collect command"):
        dataset = Dataset.open(path)
    assert not dataset.complete
    assert dataset.shards == [0, 2, 4]
    assert list(dataset.rows) == [0, 1, 2, 3, 4, 10, 11, 12, 13, 14, 20, 21, 22]
    np.testing.assert_array_equal(dataset["points"][:], arrays["points"])
    with pytest.raises(ValueError, match="unfinished and has no splits yet"):
        dataset.split("train")


def test_nothing_written_yet(tmp_path):
    writer = open_writer(tmp_path)
    assert writer.missing_shards() == [0, 1, 2, 3, 4]
    dataset = open_unfinished(tmp_path)
    assert len(dataset) == 0
    assert dataset["points"][:].shape == (0, 7, 4, 3)
    with pytest.raises(ValueError, match="unfinished: 5 of 5 shards are missing, the first is 0"):
        writer.finish()


def test_bytes_do_not_depend_on_order_or_interruptions(tmp_path):
    collect(tmp_path / "straight")
    collect(tmp_path / "resumed", shards=[3, 1])
    collect(tmp_path / "resumed", shards=[4], schema=dict(reversed(SCHEMA.items())))
    collect(tmp_path / "resumed")
    assert folder_bytes(tmp_path / "resumed") == folder_bytes(tmp_path / "straight")


def test_finished_collection_stays_as_it_is(stored):
    path, _ = stored
    before = folder_bytes(path)
    collect(path)
    assert folder_bytes(path) == before
    writer = open_writer(path)
    with pytest.raises(ValueError, match=r"shard 2 of .* is complete already"):
        writer.write(2, shard_arrays(writer, 2))


def test_one_shard_larger_than_the_collection(tmp_path):
    arrays = collect(tmp_path, n=3, shard_size=64)
    np.testing.assert_array_equal(Dataset.open(tmp_path)["points"][:], arrays["points"])


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        ({"config": {**CONFIG, "seed": 4}}, "config.seed: 3 -> 4"),
        ({"config": {**CONFIG, "rope": {"links": 5, "length": 0.5}}}, "config.rope.links: 4 -> 5"),
        ({"config": {"task": "example", "seed": 3}}, r"config.rope.links: 4 -> \(absent\)"),
        ({"config": {**CONFIG, "engine": "mjx"}}, r'config.engine: \(absent\) -> "mjx"'),
        ({"n": 24}, "trajectories: 23 -> 24"),
        ({"shard_size": 4}, "shard_size: 5 -> 4"),
        (
            {"schema": {**SCHEMA, "faults": Field((6,), "int64", "1", "bit set of faults")}},
            'fields.faults.dtype: "int32" -> "int64"',
        ),
    ],
)
def test_another_collection_is_refused_naming_what_differs(stored, options, difference):
    path, _ = stored
    before = folder_bytes(path)
    with pytest.raises(ValueError, match=rf"another data set \(old -> new\):\n  (.*\n  )*{difference}\n"):
        open_writer(path, **options)
    assert folder_bytes(path) == before


def test_other_versions_are_refused(tmp_path):
    collect(tmp_path, shards=[0])
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    manifest["versions"]["jax"] = "0.1"
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match=f'versions.jax: "0.1" -> "{jax.__version__}"'):
        open_writer(tmp_path)


def test_folders_with_other_content_are_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("text")
    (tmp_path / "figures").mkdir()
    with pytest.raises(
        ValueError, match=r"holds no data set but figures/, thesis.txt: choose a new or empty"
    ):
        open_writer(tmp_path)
    with pytest.raises(ValueError, match="is a file"):
        open_writer(tmp_path / "thesis.txt")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n": 0}, "counts must be at least 1, got 0 trajectories in shards of 5"),
        ({"shard_size": -1}, "counts must be at least 1, got 23 trajectories in shards of -1"),
        ({"config": {"seed": float("nan")}}, "the config must hold only what JSON can"),
        ({"config": {"seed": object()}}, "the config must hold only what JSON can"),
        (
            {"schema": {"a b": Field((), "int32", "1", "")}},
            "must be an identifier other than 'shards', got 'a b'",
        ),
        ({"schema": {"shards": Field((), "int32", "1", "")}}, "got 'shards'"),
    ],
)
def test_bad_arguments(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        open_writer(tmp_path / "new", **options)
    assert not (tmp_path / "new").exists()


def test_bad_fields():
    with pytest.raises(ValueError, match="boolean, integer or floating point, got 'str'"):
        Field((), "str", "1", "")
    with pytest.raises(ValueError, match=r"at least 1, got \(3, 0\): leave an empty field out"):
        Field((3, 0), "float32", "1", "")


def with_value(name, value):
    def change(arrays):
        arrays[name].flat[7] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda arrays: arrays.pop("faults"), r"shard 1: missing fields \['faults'\], unknown fields \[\]"),
        (lambda arrays: arrays.update(force=arrays["points"]), r"unknown fields \['force'\]"),
        (
            lambda arrays: arrays.update(points=arrays["points"].astype(float)),
            r"field 'points': expected float32 \(5, 7, 4, 3\), got float64 \(5, 7, 4, 3\)",
        ),
        (
            lambda arrays: arrays.update(points=arrays["points"][:3]),
            r"field 'points': expected float32 \(5, 7, 4, 3\), got float32 \(3, 7, 4, 3\)",
        ),
        (
            with_value("grippers", np.nan),
            r"'grippers': 1 values are not finite, the first is nan at \(0, 2, 0, 1\)",
        ),
        (with_value("stretch", np.inf), r"'stretch': 1 values are not finite, the first is inf at \(1, 0\)"),
    ],
)
def test_unfitting_arrays_write_nothing(tmp_path, change, message):
    writer = open_writer(tmp_path)
    before = folder_bytes(tmp_path)
    arrays = shard_arrays(writer, 1)
    change(arrays)
    with pytest.raises(ValueError, match=message):
        writer.write(1, arrays)
    assert folder_bytes(tmp_path) == before


def test_missing_values_are_kept_where_allowed(tmp_path):
    writer = open_writer(tmp_path)
    arrays = shard_arrays(writer, 0)
    arrays["stretch"][2, 3:] = np.nan
    writer.write(0, arrays)
    np.testing.assert_array_equal(open_unfinished(tmp_path)["stretch"][:], arrays["stretch"])


def test_shards_that_do_not_exist(tmp_path):
    writer = open_writer(tmp_path)
    with pytest.raises(ValueError, match="there is no shard 5: expected 0 to 4"):
        writer.write(5, shard_arrays(writer, 0))


def alter(file, position):
    content = bytearray(file.read_bytes())
    content[position] ^= 0x10
    file.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "found"),
    [
        *(
            (lambda file, at=at: alter(file, at), "has been altered: its SHA-256 differs")
            for at in (0, 5, 900, -1)
        ),
        (lambda file: file.write_bytes(file.read_bytes()[:100]), "has 100 bytes instead of"),
        (lambda file: file.write_bytes(b""), "has 0 bytes instead of"),
        (lambda file: file.unlink(), "is missing"),
    ],
)
def test_damaged_chunks_are_named_and_can_be_made_anew(tmp_path, damage, found):
    collect(tmp_path)
    before = folder_bytes(tmp_path)
    damage(tmp_path / "points" / "c.2.0.0.0")
    dataset = Dataset.open(tmp_path)
    place = rf"shard 2, field 'points': {tmp_path}/points/c\.2\.0\.0\.0"
    repair = f"to make them anew, delete {tmp_path}/shards/00002.json and run the same collect command again"
    with pytest.raises(ValueError, match=rf"^{place} {found}.*\n{repair}$"):
        dataset.verify()
    with pytest.raises(ValueError, match=rf"^(?s:{place} cannot be read: .*\n{repair})$"):
        dataset["points"][10]
    dataset["points"][:10]

    (tmp_path / "shards" / "00002.json").unlink()
    collect(tmp_path)
    assert folder_bytes(tmp_path) == before


def test_damaged_records_and_metadata_are_named(tmp_path):
    collect(tmp_path)
    before = folder_bytes(tmp_path)
    (tmp_path / "shards" / "00001.json").write_text("{}")
    with pytest.raises(ValueError, match=r"shard 1: its record .*00001\.json cannot be read"):
        Dataset.open(tmp_path).verify()
    (tmp_path / "shards" / "00001.json").unlink()

    metadata = tmp_path / "points" / "zarr.json"
    metadata.write_text(metadata.read_text().replace("float32", "float64"))
    with pytest.raises(
        ValueError, match=r"field 'points': .*zarr\.json cannot be read: float64 .* not float32"
    ):
        open_unfinished(tmp_path).verify()
    metadata.unlink()
    with pytest.raises(
        ValueError, match=r"field 'points': .*zarr\.json cannot be read.*\n.*delete it and run"
    ):
        open_unfinished(tmp_path)["points"][0]
    collect(tmp_path)
    assert folder_bytes(tmp_path) == before


def test_what_is_no_data_set(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no data set at .*: no such folder"):
        Dataset.open(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"is not a data set: no manifest\.json; it holds nothing"):
        Dataset.open(tmp_path)
    (tmp_path / "model.eqx").write_text("leaves")
    with pytest.raises(ValueError, match=r"no manifest\.json; it holds model\.eqx"):
        Dataset.open(tmp_path)
    with pytest.raises(ValueError, match="a file, where a folder was expected"):
        Dataset.open(tmp_path / "model.eqx")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"manifest\.json is not a data set's manifest"),
        ("[]", r"manifest\.json is not a data set's manifest"),
        ('{"format": "photo album"}', "'photo album', expected 'doojax dataset'"),
        ('{"format": "doojax dataset", "format_version": 1}', "it lacks config"),
        (
            '{"format": "doojax dataset", "format_version": 7}',
            "has format version 7, this doojax reads version 1: use a newer doojax",
        ),
    ],
)
def test_manifests_that_cannot_be_read(tmp_path, text, message):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        Dataset.open(tmp_path)
    with pytest.raises(ValueError, match=message):
        open_writer(tmp_path)
    assert (tmp_path / "manifest.json").read_text() == text


def test_batches_hold_each_trajectory_once_in_an_order_of_the_key(stored):
    path, arrays = stored
    dataset = Dataset.open(path)

    def order(**options):
        batches = list(dataset.batches(4, ["initial_qpos", "points"], **options))
        assert [len(batch["points"]) for batch in batches[:-1]] == [4] * (len(batches) - 1)
        values = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
        first = {row.tobytes(): i for i, row in enumerate(arrays["initial_qpos"])}
        found = [first[row.tobytes()] for row in values["initial_qpos"]]
        np.testing.assert_array_equal(values["points"], arrays["points"][found])
        return found

    assert order() == list(range(TRAJECTORIES))
    shuffled = order(key=jax.random.key(1))
    assert sorted(shuffled) == list(range(TRAJECTORIES))
    assert shuffled == order(key=jax.random.key(1))
    assert shuffled != order(key=jax.random.key(2))
    chosen = np.array([20, 3, 11, 4, 9])
    assert order(indices=chosen) == list(chosen)
    assert sorted(order(indices=chosen, key=jax.random.key(1))) == sorted(chosen)
    assert len(list(dataset.batches(23, ["points"]))) == 1
    with pytest.raises(ValueError, match="batch_size must be at least 1, got 0"):
        dataset.batches(0, ["points"])
    with pytest.raises(KeyError, match="no field 'force'"):
        dataset.batches(2, ["force"])


def test_ropes_obstacles_and_trajectories(stored):
    path, arrays = stored
    dataset = Dataset.open(path)
    rows = [3, 17, 4]
    trajectories = dataset.trajectories(rows)
    np.testing.assert_array_equal(trajectories.states.points, arrays["points"][rows])
    np.testing.assert_array_equal(trajectories.states.grippers, arrays["grippers"][rows])
    for name in ("actions", "faults", "clearance", "stretch"):
        np.testing.assert_array_equal(getattr(trajectories, name), arrays[name][rows])
    np.testing.assert_array_equal(dataset.states(3).points, arrays["points"][3])
    obstacles = dataset.obstacles(slice(2, 7))
    for name in ("kind", "centre", "quaternion", "half_size", "active"):
        np.testing.assert_array_equal(getattr(obstacles, name), arrays[f"obstacle_{name}"][2:7])


@given(environment=hnp.arrays(np.int32, st.integers(0, 120), elements=st.integers(-5, 40)))
def test_splits_are_disjoint_whole_and_keep_scenes_together(environment):
    splits = split_by_environment(environment)
    assert list(splits) == ["train", "validation", "calibration", "test"]
    assert sorted(np.concatenate(list(splits.values()))) == list(range(len(environment)))
    scenes = [set(environment[part]) for part in splits.values()]
    assert len(set().union(*scenes)) == sum(map(len, scenes))
    largest = max(np.bincount(environment + 5), default=0)
    for part, fraction in zip(splits.values(), (0.7, 0.1, 0.1, 0.1), strict=True):
        assert abs(len(part) - fraction * len(environment)) <= largest
        assert np.all(np.diff(part) > 0)
    if len(environment):
        assert len(splits["train"])


@given(
    environment=hnp.arrays(np.int32, st.integers(1, 60), elements=st.integers(0, 20)), seed=st.integers(0, 99)
)
def test_splits_do_not_depend_on_the_order_of_trajectories(environment, seed):
    order = np.random.default_rng(seed).permutation(len(environment))
    splits, shuffled = split_by_environment(environment), split_by_environment(environment[order])
    for name in splits:
        assert set(environment[splits[name]]) == set(environment[order][shuffled[name]])


def test_splits_of_equal_scenes_are_exact():
    splits = split_by_environment(np.repeat(np.arange(770), 8))
    assert [len(part) for part in splits.values()] == [4312, 616, 616, 616]
    assert not np.array_equal(splits["train"], np.arange(4312))


SPLITS = ("train", "validation", "calibration", "test")


def test_splits_of_a_data_set(tmp_path):
    collect(tmp_path / "many", n=40)
    dataset = Dataset.open(tmp_path / "many")
    assert [len(dataset.split(name)) for name in SPLITS] == [28, 4, 4, 4]
    with pytest.raises(ValueError, match="no split 'val', only train, validation, calibration, test"):
        dataset.split("val")
    collect(tmp_path / "no scenes", n=16, schema={"points": SCHEMA["points"]})
    dataset = Dataset.open(tmp_path / "no scenes")
    assert [len(dataset.split(name)) for name in SPLITS] == [11, 2, 1, 2]
    collect(tmp_path / "few", n=2)
    with pytest.raises(ValueError, match="the test split is empty: 1 scenes are too few, collect 10 or more"):
        Dataset.open(tmp_path / "few").split("test")


def test_opening_ten_thousand_trajectories_is_quick(tmp_path):
    schema = {"points": Field((10, 3), "float32", "m", "")}
    arrays = collect(tmp_path, n=10_000, shard_size=64, schema=schema)
    start = time.perf_counter()
    dataset = Dataset.open(tmp_path)
    first = dataset["points"][:64]
    assert time.perf_counter() - start < 0.5
    np.testing.assert_array_equal(first, arrays["points"][:64])
