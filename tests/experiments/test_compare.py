"""Comparisons of hand-made trials: every figure in the tables can be worked out by eye."""

import csv
import json

import imageio.v3 as iio
import numpy as np
import pytest

from doojax.experiments.compare import compare
from doojax.experiments.records import Event, Look, TrialRecord, save_record
from doojax.experiments.reports import read_summary
from doojax.experiments.scenes import draw_scenes, save_scenes
from tests.planning.problems import TOY, walls

ERRORS = {  # m; 12 scenes
    "classifier": [0.01] * 6 + [0.03] * 5 + [0.40],
    "no_classifier": [0.30] * 11 + [0.04],
    "oracle": [0.02] * 10 + [0.50, 0.02],
}
RECOVERIES = {"classifier": 2, "no_classifier": 0, "oracle": 0}


def record(method: str, trial: int, error: float) -> TrialRecord:
    reached = error <= 0.05
    about = {"final_error_m": error, "searches": 1, "extensions": 64, "actions": 0, "plan_s": 0.5}
    return TrialRecord(
        task="toy",
        method=method,
        seed=trial,
        look=Look(rope_radius=0.01),
        obstacles=walls(),
        goal=np.zeros(3),
        goal_radius=0.05,
        goal_point=0,
        points=np.zeros((1, 5, 3)),
        grippers=np.zeros((1, 1, 3)),
        plans=(),
        events=(Event(0, "end", "goal reached" if reached else "10 searches did not suffice"),),
        reached=reached,
        about=about | {"recovery_actions": RECOVERIES[method]},
    )


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "all.scenes"
    save_scenes(path, draw_scenes(TOY, 12, 0))
    return path


@pytest.fixture
def folder(tmp_path, scene_file):
    """An evaluation, as doojax evaluate leaves it."""
    out = tmp_path / "evaluation"
    for method, errors in ERRORS.items():
        (out / method).mkdir(parents=True)
        (out / method / "method.json").write_text("{}")
        (out / method / "seconds.jsonl").write_text('{"trials": 12, "seconds": 90.0}\n{"trials": 1, "sec')
        for trial, error in enumerate(errors):
            save_record(out / method / f"{trial:05d}.npz", record(method, trial, error))
    (out / "config.json").write_text(json.dumps({"task": "toy", "seed": 3}))
    (out / "all.scenes").write_bytes(scene_file.read_bytes())
    return out


def table(path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_the_tables_say_what_happened(folder):
    compare(folder)
    out = folder / "comparison"
    methods = {line["method"]: line for line in table(out / "methods.csv")}
    mine = methods["classifier"]
    assert mine["success"].startswith("91.7 % (65 to ")  # 11 of 12, Wilson
    assert (mine["max (m)"], mine["recovery actions"], mine["minutes"]) == ("0.400", "24", "1.5")
    assert mine["mean (m)"].startswith("0.051 (")  # (6 * 0.01 + 5 * 0.03 + 0.4) / 12
    assert mine["median (m)"].startswith("0.020 (")
    assert methods["no_classifier"]["success"].startswith("8.3 %")

    pairs = {(line["method"], line["against"]): line for line in table(out / "tests.csv")}
    first = pairs["classifier", "no_classifier"]
    assert first["success"].startswith("83.3 %")
    assert first["p (McNemar)"] == "0.0063"  # 11 won, 1 lost: 2 (1 + 12) / 2^12
    assert first["median error"].startswith("-0.280")
    assert pairs["classifier", "oracle"]["p (McNemar)"] == "1"

    trials = table(out / "trials.csv")
    assert len(trials) == 36
    errors = [float(line["final_error_m"]) for line in trials if line["method"] == "oracle"]
    assert errors == pytest.approx(ERRORS["oracle"])

    text = (out / "comparison.md").read_text()
    assert "# toy: 3 methods on 12 scenes" in text
    assert "| solved by the oracle | 91.7 %" in text
    (solved,) = [line for line in text.splitlines() if "solved by the oracle" in line]
    assert solved.endswith("| 91 % | 9 % | 100 % |")  # 10 and 1 of the oracle's 11
    assert "| goal reached | 11 | 1 | 11 |" in text


def test_what_was_not_the_default_is_said(folder):
    planning, budget = {"lanes": 64, "shortcuts": 0}, {"searches": 40, "replan_distance": 0.1}
    config = {"task": "toy", "seed": 3, "scenes": "0123", "planning": planning, "budget": budget}
    (folder / "config.json").write_text(json.dumps(config))
    compare(folder, summary=folder / "summary.json")
    command = "doojax evaluate toy --methods classifier no_classifier oracle "
    command += f"--scenes {folder / 'all.scenes'} --planning.shortcuts 0 "
    command += "--budget.searches 40 --budget.replan-distance 0.1"
    assert f"Made by `{command}`, seed 3." in (folder / "comparison" / "comparison.md").read_text()
    assert read_summary(folder / "summary.json").runs[0].command == command


def test_the_figure_shows_a_curve_for_every_method(folder):
    compare(folder)
    image = iio.imread(folder / "comparison" / "success.png")[..., :3].astype(int)
    for colour in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00), (0x00, 0x9E, 0x73)):
        assert (np.abs(image - colour).sum(-1) < 10).sum() > 200
    assert (np.abs(image - [0xCC, 0x79, 0xA7]).sum(-1) < 10).sum() == 0


def test_the_figures_reach_a_summary(folder, tmp_path):
    compare(folder, out=tmp_path / "out", summary=tmp_path / "summary.json")
    summary = read_summary(tmp_path / "summary.json")
    assert summary.runs[-1].seed == 3
    assert summary.runs[-1].command == "doojax evaluate toy --methods classifier no_classifier oracle"
    found = {row.identity: row for row in summary.rows}
    rate = found['success_rate {"method": "classifier", "task": "toy"}']
    assert (rate.value, rate.n) == (pytest.approx(11 / 12), 12) and rate.low < rate.value < rate.high
    assert found['recovery_actions {"method": "classifier", "task": "toy"}'].value == 24
    assert found['oracle_success {"scenes": 12, "task": "toy"}'].value == pytest.approx(11 / 12)
    metrics = {row.metric for row in summary.rows}
    assert metrics == {
        *("success_rate", "final_error_mean_m", "final_error_median_m", "recovery_actions", "plan_s"),
        *("p_value", "oracle_success", "evaluate_minutes"),
    }
    assert sum(row.metric == "p_value" for row in summary.rows) == 9
    assert (tmp_path / "out" / "success.png").exists() and not (folder / "comparison").exists()


def test_methods_are_compared_on_the_scenes_that_all_have_done(folder):
    for trial in range(6):
        (folder / "no_classifier" / f"{trial:05d}.npz").unlink()
    compare(folder)
    text = (folder / "comparison" / "comparison.md").read_text()
    assert "3 methods on 6 scenes" in text
    methods = {line["method"]: line for line in table(folder / "comparison" / "methods.csv")}
    assert methods["classifier"]["success"].startswith("83.3 %")  # the last 6 of its 12


def test_what_is_no_evaluation_is_refused(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no evaluation: doojax evaluate writes one"):
        compare(tmp_path)
    for trial in range(12):
        if trial < 6:
            (folder / "no_classifier" / f"{trial:05d}.npz").unlink()
        else:
            (folder / "oracle" / f"{trial:05d}.npz").unlink()
    with pytest.raises(ValueError, match="have no scene in common"):
        compare(folder)
    for path in folder.rglob("0*.npz"):
        path.unlink()
    with pytest.raises(ValueError, match="holds no finished trial yet"):
        compare(folder)
    assert not (folder / "comparison").exists()
