"""Comparisons of hand-made trials: every figure in the tables can be worked out by eye."""

import csv
import json
import shutil
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from doojax.commands import parsed
from doojax.experiments.reports.compare import compare, scene_tags, setting_tags, success_figure
from doojax.experiments.reports.provenance import note_command
from doojax.experiments.reports.summary import read_summary, row, show
from doojax.experiments.trials.outcomes import read_evaluation
from doojax.experiments.trials.record_files import save_record
from doojax.experiments.trials.records import Event, TrialRecord
from doojax.experiments.trials.scenes import FOLDER, draw_scenes, load_scenes, save_scenes
from doojax.files import file_digest
from tests.planning.problems import TOY, walls
from tests.records import record_of

ERRORS = {  # m; 12 scenes
    "classifier": [0.01] * 6 + [0.03] * 5 + [0.40],
    "no_classifier": [0.30] * 11 + [0.04],
    "oracle": [0.02] * 10 + [0.50, 0.02],
}
RECOVERIES = {"classifier": 2, "no_classifier": 0, "oracle": 0}


def record(method: str, trial: int, error: float) -> TrialRecord:
    reached = error <= 0.05
    about = {"final_error_m": error, "searches": 1, "extensions": 64, "actions": 0, "plan_s": 0.5}
    return record_of(
        np.zeros((1, 5, 3)),
        method=method,
        seed=trial,
        obstacles=walls(),
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


def test_the_commands_that_ran_are_the_ones_that_are_recorded(folder, tmp_path):
    first = "doojax evaluate toy --methods classifier --out trials --models runs --seed 3 --engine mjx"
    second = "doojax evaluate toy --methods oracle --out trials --trials 12 --scenes mine.scenes"
    note_command(folder, first, 3, {"scenes": "0123", "classifier/dynamics": "4567"})
    note_command(folder, second, 3, {"scenes": "0123"})
    note_command(folder, first, 3, {"scenes": "0123", "classifier/dynamics": "4567"})  # resumed
    before = [json.loads(line) for line in (folder / "commands.jsonl").read_text().splitlines()]
    elsewhere = "".join(json.dumps(run | {"device": "a larger machine"}) + "\n" for run in before)
    (folder / "commands.jsonl").write_text(elsewhere)
    compare(folder, publish=tmp_path)
    own = f"doojax compare {folder} --publish {tmp_path}"
    made = f"Made by `{first} && {second} && {own}`, seed 3."
    assert made in (folder / "comparison" / "comparison.md").read_text()
    (run,) = read_summary(tmp_path / "summary.json").runs
    assert run.command == f"{first} && {second} && {own}"
    assert run.inputs == {"scenes": "0123", "classifier/dynamics": "4567"}
    assert run.device == "a larger machine", "where trials ran counts, not where they are compared"
    ran, again, _ = parsed(run.command)
    assert ran[1]["models"] == Path("runs") and ran[1]["engine"] == "mjx"
    assert again[1]["trials"] == 12 and again[1]["scenes"] == Path("mine.scenes")


def test_what_does_not_say_how_it_was_made_is_not_published(folder, tmp_path):
    with pytest.raises(ValueError, match="does not say by which command it was made: evaluate anew"):
        compare(folder, publish=tmp_path)
    assert not list(tmp_path.glob("*.json"))


def test_a_ninth_method_is_drawn_and_one_that_is_unknown_is_read(folder):
    for number in range(8):
        shutil.copytree(folder / "oracle", folder / f"other_{number}")
    _, outcomes = read_evaluation(folder)
    assert [one.method for one in outcomes[:3]] == ["classifier", "no_classifier", "oracle"]
    axes = success_figure(outcomes, "many").axes[0]
    curves = [line for line in axes.get_lines() if len(line.get_xdata()) > 2]
    assert len(curves) == len(axes.get_legend().get_texts()) == 11
    assert len({(line.get_color(), line.get_linestyle()) for line in curves}) == 11


def test_the_figure_shows_a_curve_for_every_method(folder):
    compare(folder)
    image = iio.imread(folder / "comparison" / "success.png")[..., :3].astype(int)
    for colour in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00), (0x00, 0x9E, 0x73)):
        assert (np.abs(image - colour).sum(-1) < 10).sum() > 200
    assert (np.abs(image - [0xCC, 0x79, 0xA7]).sum(-1) < 10).sum() == 0


def test_the_figures_reach_a_summary(folder, tmp_path):
    note_command(folder, "doojax evaluate toy --methods oracle --out x --seed 3", 3, {})
    compare(folder, out=tmp_path / "out", publish=tmp_path)
    summary = read_summary(tmp_path / "summary.json")
    assert summary.runs[-1].seed == 3
    found = {row.identity: row for row in summary.rows}
    rate = found['success_rate {"difficulty": "easy", "method": "classifier", "task": "toy"}']
    assert (rate.value, rate.n) == (pytest.approx(11 / 12), 12) and rate.low < rate.value < rate.high
    assert found['recovery_actions {"difficulty": "easy", "method": "classifier", "task": "toy"}'].value == 24
    assert found['oracle_success {"difficulty": "easy", "scenes": 12, "task": "toy"}'].value == pytest.approx(
        11 / 12
    )
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


def test_rows_say_the_seed_of_scenes_that_do_not_come_along(scene_file):
    own = load_scenes(scene_file)
    tags = scene_tags("toy", own, file_digest(scene_file)[:16])
    assert tags == {"task": "toy", "difficulty": "easy", "scene_seed": 0}
    known = file_digest(FOLDER / "rope_dragging_narrow.scenes")[:16]
    assert "scene_seed" not in scene_tags("rope_dragging", own, known)


def test_rows_say_which_settings_were_not_the_default():
    plain = {"searches": 10, "actions": 200, "replan_distance": None}
    assert setting_tags({"budget": plain, "accept": None}) == {}
    assert setting_tags({"budget": plain | {"searches": 1}, "margin": 0.0}) == {"searches": 1, "margin": 0.0}
    assert setting_tags({"budget": plain, "accept": "conformal:0.05"}) == {"accept": "conformal:0.05"}


def test_failed_trials_say_why_in_the_tables(folder):
    compare(folder)
    out = folder / "comparison"
    whys = {(line["method"], line["trial"]): line["why"] for line in table(out / "trials.csv")}
    assert whys["classifier", "11"] == "10 searches did not suffice"
    text = (out / "comparison.md").read_text()
    assert "| scene | method | error (m) | why |" in text
    assert "| 11 | classifier | 0.400 | 10 searches did not suffice |" in text
    assert text.count("| no_classifier | 0.300 |") == 11  # as many as failed


def test_names_are_whole_on_a_terminal_of_eighty_columns(folder, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    shutil.copytree(folder / "classifier", folder / "collision_checker")
    compare(folder)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    (mine,) = [line for line in lines if "collision_checker" in line]
    assert " ".join(mine.split()) == "collision_checker 91.7 % (65 to 99) 0.051 0.020 24 0.50 s"
    tags = {"model": "voxel_classifier"}
    show([row("classifier_us_per_transition", tags, 1, "us", 0.5, 12345678.0)], False)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any("classifier_us_per_transition" in line and "0.5 to 1.235e+07" in line for line in lines)
    assert any("voxel_classifier" in line for line in lines)
