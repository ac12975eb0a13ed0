import contextlib
import re
import tracemalloc

import numpy as np
import pytest
import zarr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from doojax.datasets import Dataset, Field
from doojax.datasets.inspect import FieldStatistics, inspect, summarise
from doojax.simulation.state import Fault

from .example_collection import SCHEMA, collect, open_writer, shard_arrays


def overwrite(path, name, index, values):
    """Change stored values behind the data set's back."""
    array = zarr.open_array(path / name, mode="r+")
    array[index] = values


@given(
    shards=st.lists(
        hnp.arrays(np.float32, st.integers(0, 9), elements=st.floats(-1e3, 1e3, width=32) | st.just(np.nan)),
        min_size=1,
        max_size=5,
    )
)
def test_running_statistics_are_those_of_all_values_together(shards):
    statistics = FieldStatistics()
    for values in shards:
        statistics.add(values)
    everything = np.concatenate(shards).astype(float)
    present = everything[~np.isnan(everything)]
    assert statistics.missing == len(everything) - len(present)
    assert statistics.count == len(present)
    if len(present):
        assert (statistics.minimum, statistics.maximum) == (present.min(), present.max())
        np.testing.assert_allclose(statistics.mean, present.mean(), atol=1e-9)
        np.testing.assert_allclose(statistics.deviation, present.std(), rtol=1e-9, atol=1e-9)


def test_summary_counts_faults_clearance_and_stretch(tmp_path):
    writer = open_writer(tmp_path)
    for shard in writer.missing_shards():
        arrays = shard_arrays(writer, shard)
        arrays["stretch"][:] = np.nan if shard == 4 else 0.02
        arrays["clearance"][:] = 0.1
        if shard == 1:
            arrays["faults"][2, 3] = Fault.NOT_FINITE | Fault.CONTACTS_DROPPED
            arrays["faults"][2, 4] = Fault.NOT_FINITE
            arrays["faults"][4, 0] = Fault.CONTACTS_DROPPED
            arrays["stretch"][0, 0] = 0.5
            arrays["clearance"][1, 1:3] = 0.0005
            arrays["clearance"][3, 1:5] = -0.0025
        writer.write(shard, arrays)
    writer.finish()
    summary = summarise(Dataset.open(tmp_path))
    assert summary.facts == {
        "trajectories with a fault": (2, 23),
        "trajectories with NOT_FINITE": (1, 23),
        "trajectories with UNSTABLE": (0, 23),
        "trajectories with CONTACTS_DROPPED": (2, 23),
        "trajectories with SCENE_OVERFULL": (0, 23),
        "trajectories with PASSED_THROUGH": (0, 23),
        "trajectories with NEIGHBOURS_DROPPED": (0, 23),
        "trajectories with STEP_TOO_LONG": (0, 23),
        "states within 1 mm of an obstacle": (6, 23 * 7),
        "trajectories within 1 mm of an obstacle": (2, 23),
        "states more than 2 mm inside an obstacle": (4, 23 * 7),
        "states stretched by more than 1%": (20 * 7, 23 * 7),
        "states stretched by more than 3%": (1, 23 * 7),
    }
    assert summary.statistics["stretch"].missing == 3 * 7
    assert not any(summary.checks.values())


def test_what_is_printed(tmp_path, capsys):
    arrays = collect(tmp_path / "data")
    inspect(tmp_path / "data")
    text = capsys.readouterr().out
    lines = {line.split()[0]: line.split() for line in text.splitlines() if line.strip()}
    assert "23 trajectories in 5 shards (complete)" in " ".join(text.split())
    assert '"task": "example"' in text
    points = arrays["points"].astype(float)
    numbers = [f"{value:.3g}" for value in (points.min(), points.max(), points.mean(), points.std())]
    assert lines["points"] == ["points", *numbers]
    assert re.search(r"^points .*\nfloat32, 7 4 3, m ", text, re.MULTILINE)
    for name in SCHEMA:
        assert name in lines
    for check in ("checksums", "finite", "unit quaternions", "distinct trajectories"):
        assert f"{check}: ok" in text


def test_names_of_fields_are_whole_in_a_terminal_of_80_columns(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    names = ("obstacle_quaternion", "initial_commanded", "initial_qpos")
    schema = {name: Field((2, 3), "float32", "m, rad", "") for name in names}
    collect(tmp_path / "data", schema=schema)
    for name in names:  # numbers as wide as they come, and one that is missing
        overwrite(tmp_path / "data", name, (0, 0), [-1e24, 1e-24, np.nan])
    with contextlib.suppress(ValueError):
        inspect(tmp_path / "data", verify=False)
    table = [line for line in capsys.readouterr().out.splitlines() if line.startswith(names)]
    assert len(table) == 3
    for line in table:
        assert len(line.split()) == 6 and "e+24" in line and len(line) <= 80


def test_an_unfinished_set_is_described_as_such(tmp_path, capsys):
    collect(tmp_path / "data", shards=[1, 4])
    inspect(tmp_path / "data", verify=False)
    text = " ".join(capsys.readouterr().out.split())
    assert "8 trajectories in 2 shards (UNFINISHED, of 23 in 5)" in text
    assert "checksums: not checked" in text


def test_an_empty_set(tmp_path, capsys):
    open_writer(tmp_path / "data")
    inspect(tmp_path / "data")
    assert "0 trajectories in 0 shards" in capsys.readouterr().out


def test_altered_files_are_found_first(tmp_path):
    collect(tmp_path)
    overwrite(tmp_path, "points", (7, 0, 0, 0), 9.0)
    with pytest.raises(ValueError, match=r"shard 1, field 'points': .*c\.1\.0\.0\.0 ha"):
        inspect(tmp_path)
    inspect(tmp_path, verify=False)


@pytest.mark.parametrize(
    ("name", "index", "values", "problem"),
    [
        ("points", (7, 0, 0, 0), np.nan, "finite: points: 1 values are not"),
        ("stretch", (7, slice(0, 2)), np.inf, "finite: stretch: 2 values are not"),
        ("obstacle_quaternion", 11, 2.0, "unit quaternions: obstacle_quaternion: 2 are not"),
    ],
)
def test_failed_checks_say_what_is_wrong(tmp_path, capsys, name, index, values, problem):
    collect(tmp_path)
    overwrite(tmp_path, name, index, values)
    with pytest.raises(ValueError, match=f"fails its checks:\n{problem}$"):
        inspect(tmp_path, verify=False)
    assert f"{problem.split(':')[0]}: FAILED" in capsys.readouterr().out


def test_repeated_trajectories_are_found_across_shards(tmp_path):
    writer = open_writer(tmp_path)
    for shard in writer.missing_shards():
        arrays = shard_arrays(writer, shard)
        if shard == 4:
            first = shard_arrays(writer, 0)
            arrays = {name: np.concatenate([first[name][1:2], values[1:]]) for name, values in arrays.items()}
            arrays["environment"][0] = 99
        writer.write(shard, arrays)
    with pytest.raises(ValueError, match=r"distinct trajectories: trajectory 20 repeats trajectory 1$"):
        inspect(tmp_path)


def test_memory_does_not_grow_with_the_data_set(tmp_path):
    schema = {"points": Field((50, 20, 3), "float32", "m", "")}
    collect(tmp_path, n=640, shard_size=16, schema=schema)
    dataset = Dataset.open(tmp_path)
    shard = 16 * 50 * 20 * 3 * 4
    tracemalloc.start()
    summarise(dataset)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 * shard < 640 / 16 * shard / 3
