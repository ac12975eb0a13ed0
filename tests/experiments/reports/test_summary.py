"""The summary files: what is merged, kept, refused."""

import json
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from doojax.experiments.reports.rows import Run, Summary
from doojax.experiments.reports.summary import read_summary, row, show, to_json, write_summary

SPEED = row("steps_per_s", {"task": "toy", "batch": 64}, 1200.0, "1/s", low=1100.0, high=1300.0, n=5)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "results" / "simulation" / "summary.json"


def test_what_is_written_is_what_is_read(path):
    other = row("compile_s", {"task": "toy"}, 2.5, "s")
    written = write_summary(path, command="doojax bench rollouts", seed=3, rows=[SPEED, other])
    assert read_summary(path) == written
    assert written.rows == (other, SPEED)  # by metric
    (run,) = written.runs
    assert (run.command, run.seed) == ("doojax bench rollouts", 3)
    assert {"python", "doojax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy"} <= set(run.versions)
    assert "core" in run.device


def test_the_file_has_the_designs_fields_and_one_row_per_line(path):
    write_summary(path, command="c", seed=None, rows=[SPEED])
    text = path.read_text()
    content = json.loads(text)
    assert set(content) == {"command", "seed", "versions", "device", "date", "runs", "rows"}
    fields = {"metric", "tags", "value", "low", "high", "n", "unit", "run"}
    assert set(content["rows"][0]) == fields
    assert sum("steps_per_s" in line for line in text.splitlines()) == 1
    assert not list(path.parent.glob(".*")), "the temporary file is gone"


def test_scalars_of_numpy_and_jax_become_numbers():
    made = row("error", {"batch": np.int64(4), "on": np.True_}, jnp.float32(0.5), "m", n=np.int32(9))  # type: ignore
    assert made == row("error", {"batch": 4, "on": True}, 0.5, "m", n=9)
    assert [type(made.value), type(made.n), type(made.tags["batch"])] == [float, int, int]


def test_a_row_measured_again_moves_to_the_new_run_and_the_others_keep_theirs(path):
    free = row("gap_m", {"contact": False}, 1e-4, "m")
    hit = row("gap_m", {"contact": True}, 1e-2, "m")
    write_summary(path, command="first", seed=0, rows=[free, hit])
    again = write_summary(path, command="second", seed=1, rows=[row("gap_m", {"contact": True}, 2e-2, "m")])

    made_by = {each.tags["contact"]: (again.runs[each.run].command, each.value) for each in again.rows}
    assert made_by == {False: ("first", 1e-4), True: ("second", 2e-2)}
    head = json.loads(path.read_text())
    assert (head["command"], head["seed"]) == ("second", 1)

    last = write_summary(path, command="third", seed=2, rows=[free])
    assert [run.command for run in last.runs] == ["second", "third"], "no row is left of the first"


def test_order_of_tags_does_not_matter_and_their_type_does(path):
    write_summary(path, command="c", seed=0, rows=[row("m", {"a": 1, "b": 2}, 1.0, "")])
    merged = write_summary(path, command="c", seed=0, rows=[row("m", {"b": 2, "a": 1}, 5.0, "")])
    assert [each.value for each in merged.rows] == [5.0]
    merged = write_summary(path, command="c", seed=0, rows=[row("m", {"b": 2, "a": "1"}, 7.0, "")])
    assert len(merged.rows) == 2


def test_rows_are_sorted_by_the_size_of_numbers(path):
    rows = [row("m", {"batch": batch}, 1.0, "") for batch in (1024, 16, "all", 256)]
    merged = write_summary(path, command="c", seed=0, rows=rows)
    assert [each.tags["batch"] for each in merged.rows] == [16, 256, 1024, "all"]


tags = st.dictionaries(
    st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True),
    st.text(max_size=5) | st.integers(-9, 9) | st.booleans() | st.floats(-9, 9),
    max_size=3,
)


@given(st.lists(st.tuples(tags, st.floats(allow_nan=False, allow_infinity=False)), min_size=1, max_size=6))
def test_any_summary_survives_a_round_trip(tmp_path_factory, drawn):
    rows = {each.identity: each for each in (row("m", tag, value, "µm") for tag, value in drawn)}
    summary = Summary((Run("a 'b' \"c\"", None, {}, "cpu™", "2026-11-23"),), tuple(rows.values()))
    path = tmp_path_factory.mktemp("trip") / "summary.json"
    path.write_text(to_json(summary), encoding="utf-8")
    assert read_summary(path) == summary


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"value": float("nan")}, r"value of m \{'task': 'toy'\} is nan; expected a finite number"),
        ({"value": float("inf")}, "is inf; expected a finite number"),
        ({"metric": "Steps per s"}, "metric is 'Steps per s'; expected lower-case letters"),
        ({"tags": {"eta": float("nan")}}, "tag 'eta' is nan"),
        ({"tags": {"eta": [1]}}, r"tag 'eta' is \[1\]"),
        ({"low": 2.0, "high": 1.0}, r"interval of m .* is \(2.0, 1.0\); expected finite low <= high"),
        ({"low": 0.0}, r"interval of m .* is \(0.0, None\)"),
        ({"low": 0.0, "high": float("nan")}, r"interval of m"),
        ({"n": 0}, "n is 0; expected a positive integer"),
    ],
)
def test_a_malformed_row_is_refused(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        row(**{"metric": "m", "tags": {"task": "toy"}, "value": 1.0, "unit": "m"} | arguments)


def test_rows_that_contradict_each_other_are_refused_and_the_file_stays(path):
    write_summary(path, command="c", seed=0, rows=[SPEED])
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"steps_per_s .*toy.* is there twice"):
        write_summary(path, command="c", seed=0, rows=[SPEED, SPEED])
    with pytest.raises(ValueError, match=r"steps_per_s is given in '1/s' and in 'Hz'"):
        write_summary(path, command="c", seed=0, rows=[row("steps_per_s", {"task": "z"}, 1.0, "Hz")])
    with pytest.raises(ValueError, match="there are no rows"):
        write_summary(path, command="c", seed=0, rows=[])
    with pytest.raises(ValueError, match=r"must end in \.json"):
        write_summary(path.parent, command="c", seed=0, rows=[SPEED])
    assert path.read_bytes() == before


def test_a_crash_while_writing_leaves_the_old_file(path, monkeypatch):
    write_summary(path, command="c", seed=0, rows=[SPEED])
    before = path.read_bytes()

    def full(_):
        raise OSError(28, "no room left to write to on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no room left to write to"):
        write_summary(path, command="d", seed=0, rows=[row("m", {}, 1.0, "")])
    assert [file.name for file in path.parent.iterdir()] == ["summary.json"]
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('"value": 1200.0', '"value": NaN', "it holds NaN; figures must be finite"),
        ('"value": 1200.0', '"value": "fast"', r"rows\[0\]: value of steps_per_s .* is 'fast'"),
        ('"value": 1200.0, ', "", r"rows\[0\]: it lacks value"),
        ('"value"', '"worth"', r"rows\[0\]: it lacks value and has unknown worth"),
        ('"run": 0', '"run": 1', "run of steps_per_s .* is 1; expected below 1"),
        ('"seed": 0', '"seed": "zero"', r"runs\[0\]: seed is 'zero'"),
        ('"command": "c", "seed"', '"command": "d", "seed"', "must repeat those of the last run"),
        ('"rows"', '"lines"', "it lacks rows and has unknown lines"),
        ("}\n]", "}", "Expecting"),
        ("{\n", "[]\n", "Extra data"),
    ],
)
def test_a_damaged_file_is_refused_by_name(path, old, new, complaint):
    write_summary(path, command="c", seed=0, rows=[SPEED])
    text = path.read_text().replace("\n ]\n}", "\n]\n}")
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=rf"(?s)summary\.json is not a summary of results: .*{complaint}"):
        read_summary(path)


@pytest.mark.parametrize("text", ["[]", "3", '{"rows": []}', ""])
def test_a_file_of_something_else_is_refused(path, text):
    path.parent.mkdir(parents=True)
    path.write_text(text)
    with pytest.raises(ValueError, match=r"summary\.json is not a summary of results: .*Mend or delete it"):
        read_summary(path)


def test_a_missing_file_is_named(path):
    with pytest.raises(FileNotFoundError, match=r"summary\.json"):
        read_summary(path)


RESULTS = sorted((Path(__file__).parents[3] / "results").glob("*/summary.json"))


@pytest.mark.parametrize("file", RESULTS, ids=lambda file: file.parent.name)
def test_names_are_whole_in_a_terminal_of_80_columns(file, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    rows = read_summary(file).rows
    show(rows, False)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80 and not any("…" in line for line in lines)
    assert {one.metric for one in rows} <= {line.split()[0] for line in lines if line.strip()}
