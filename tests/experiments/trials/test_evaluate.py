"""Evaluations on the toy task: what is run, what is not run again, what is refused."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from doojax.commands import parsed
from doojax.experiments.reports.provenance import digest, noted_commands
from doojax.experiments.trials.evaluate import attempted, evaluate, group_of, record_file
from doojax.experiments.trials.methods import RECIPES
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.scenes import FOLDER, draw_scenes, save_scenes, scene_file
from doojax.experiments.trials.setting import Method
from doojax.experiments.trials.trial import run_trials
from tests.planning.problems import BLIND, Towed

from .test_trial import counted
from .toy_trials import METHODS, PLANNING, SETTINGS, SIMULATOR, TOY, trials

METHOD = "collision_checker"
RUN = "doojax.experiments.trials.evaluate.run_trials"


def unplanned(task, simulator, method, planning, budget, trials, *, keep_trees=False):
    """Records of trials that end before they begin."""
    nobody = trials._replace(wanted=[False] * len(trials.numbers))
    return run_trials(task, simulator, method, planning, budget, nobody)


@pytest.fixture(scope="module", autouse=True)
def nothing_is_planned():
    """No search is compiled, but in slow tests; `test_other_tasks` evaluates with plans."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(RUN, unplanned)
        yield


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "toy.scenes"
    save_scenes(path, draw_scenes(TOY, 7, 0))
    return path


@pytest.fixture(scope="module")
def run(scenes, nothing_is_planned):
    """Evaluate with what all these tests share."""

    def evaluated(out: Path, **options):
        chosen = {"methods": (METHOD,), "scenes": scenes, "side_by_side": 3}
        evaluate("toy", out=out, planning=PLANNING, budget=SETTINGS, **{**chosen, **options})
        return out

    return evaluated


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """All seven trials, uninterrupted."""
    return run(tmp_path_factory.mktemp("evaluations") / "whole")


def same(one: Path, other: Path) -> bool:
    """Do two records tell the same, but for the seconds?"""
    first, second = load_record(one), load_record(other)
    arrays = zip(first.replay.values(), second.replay.values(), strict=True)
    return (
        np.array_equal(first.points, second.points)
        and all(np.array_equal(a, b) for a, b in arrays)
        and first.events == second.events
        and counted(first) == counted(second)
    )


def test_one_record_for_every_scene(whole):
    files = [record_file(whole, METHOD, i) for i in range(7)]
    assert sorted(whole.rglob("*.npz")) == files
    records = [load_record(file) for file in files]
    assert [record.about["trial"] for record in records] == list(range(7))
    assert {record.seed for record in records} == {0}
    assert len({record.points[0].tobytes() for record in records}) == 7
    seconds = [json.loads(line) for line in (whole / METHOD / "seconds.jsonl").read_text().splitlines()]
    assert [entry["trials"] for entry in seconds] == [3, 3, 1]
    config = json.loads((whole / "config.json").read_text())
    assert config["planning"]["lanes"] == 16 and config["budget"]["searches"] == 4


@pytest.mark.slow
def test_more_trials_are_the_same_and_more_and_none_is_run_again(run, whole, tmp_path):
    out = run(tmp_path / "out", trials=2)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    assert len(before) == 2
    run(out)
    assert all(path.stat().st_mtime_ns == then for path, then in before.items())
    assert all(same(record_file(out, METHOD, i), record_file(whole, METHOD, i)) for i in range(7))


@pytest.mark.slow
def test_killed_and_resumed_it_ends_with_the_same_trials(run, scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(RUN, run_trials)
    out, whole = tmp_path / "out", run(tmp_path / "whole")
    code = """
import sys
from pathlib import Path
from doojax.experiments.trials.evaluate import evaluate
from tests.experiments.trials.toy_trials import PLANNING, SETTINGS
evaluate("toy", methods=("collision_checker",), scenes=Path(sys.argv[1]), out=Path(sys.argv[2]),
         planning=PLANNING, budget=SETTINGS, side_by_side=3)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(scenes), str(out)], stderr=subprocess.PIPE, env={**os.environ}
    )
    limit = time.monotonic() + 200
    while not record_file(out, METHOD, 0).exists():
        assert process.poll() is None, process.stderr.read().decode()
        assert time.monotonic() < limit
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    done = {path for path in out.rglob("*.npz") if not path.name.startswith(".")}
    assert 1 <= len(done) < 7
    contents = {path: path.read_bytes() for path in done}
    run(out)
    assert all(path.read_bytes() == content for path, content in contents.items())
    assert all(same(record_file(out, METHOD, i), record_file(whole, METHOD, i)) for i in range(7))


def test_methods_may_be_added_later_and_share_the_scenes(run, whole, tmp_path):
    out = run(tmp_path / "out", trials=1)
    run(out, trials=1, methods=("oracle", METHOD))
    first, second = (load_record(record_file(out, name, 0)) for name in (METHOD, "oracle"))
    assert np.array_equal(first.points[0], second.points[0])
    assert np.array_equal(first.goal, second.goal)
    assert first.method == METHOD and second.method == "oracle"


def test_a_group_is_always_as_large_and_depends_on_no_number_of_trials():
    assert group_of(0, 3, 7) == [0, 1, 2]
    assert group_of(2, 3, 7) == [6, 0, 1]
    assert group_of(0, 4, 2) == [0, 1, 0, 1]


class Poisoned:
    """Dynamics outside of jit that fail for one scene."""

    def __init__(self, tail):
        self.tail = np.asarray(tail)

    def many(self, obstacles, states, actions):
        if np.any(np.all(np.asarray(states.points[:, :, 0]) == self.tail, axis=-1)):
            raise RuntimeError("no such rope\nand more")
        return towed(obstacles, states, actions)


towed = jax.jit(jax.vmap(jax.vmap(Towed(), in_axes=(None, 0, 0))))


def test_a_trial_that_crashes_is_recorded_and_takes_no_other_along(monkeypatch):
    some, asked = trials(), []

    def failing(task, simulator, method, planning, budget, some, keep_trees):
        """Nothing is planned, and where the second is wanted there is an error."""
        wanted = some.wanted or [True] * 3
        asked.append([number for number, run in zip(some.numbers, wanted, strict=True) if run])
        if 8 in asked[-1]:
            raise RuntimeError("no such rope\nand more")
        return unplanned(task, simulator, method, planning, budget, some)

    monkeypatch.setattr(RUN, failing)
    ran = attempted(TOY, SIMULATOR, METHODS["no_classifier"], PLANNING, SETTINGS, some)
    assert asked == [[7, 8, 9], [7], [8], [9]]
    assert ran[1].end == "crashed: RuntimeError: no such rope"
    assert "in failing" in ran[1].about["traceback"]
    assert ran[1].about["final_error_m"] == pytest.approx(
        np.linalg.norm(ran[1].points[0, 0] - ran[1].goal), abs=1e-6
    )
    own = np.asarray(SIMULATOR.observations(some.starts).state.points)
    for index, number in ((0, 7), (2, 9)):
        assert not ran[index].end.startswith("crashed") and ran[index].about["trial"] == number
        np.testing.assert_array_equal(ran[index].points[0], own[index])


@pytest.mark.slow  # beside it the same of trials that plan nothing
def test_what_crashes_outside_of_jit_leaves_the_others_their_plans(monkeypatch):
    monkeypatch.setattr(RUN, run_trials)
    some = trials()
    tail = SIMULATOR.observations(some.starts).state.points[1, 0]
    blind = Method("blind", Towed(), BLIND)
    poisoned = Method("poisoned", Poisoned(tail), BLIND)
    ran = attempted(TOY, SIMULATOR, poisoned, PLANNING, SETTINGS, some)
    healthy = attempted(TOY, SIMULATOR, blind, PLANNING, SETTINGS, some)
    assert ran[1].end == "crashed: RuntimeError: no such rope"
    assert "in many" in ran[1].about["traceback"]
    assert ran[1].about["final_error_m"] == pytest.approx(
        np.linalg.norm(ran[1].points[0, 0] - ran[1].goal), abs=1e-6
    )
    for index in (0, 2):
        assert not ran[index].end.startswith("crashed")
        assert ran[index].plans[0].points[0] == pytest.approx(healthy[index].plans[0].points[0])


def test_a_method_all_of_whose_trials_crash_is_an_error(run, tmp_path, monkeypatch):
    def fail(*arguments, **options):
        raise RuntimeError("no memory")

    monkeypatch.setattr(RUN, fail)
    message = f"2 of 2 trials of {METHOD} crashed: RuntimeError: no memory"
    with pytest.raises(ValueError, match=message):  # status 2, from the command line
        run(tmp_path / "a", trials=2)
    assert "no memory" in load_record(record_file(tmp_path / "a", METHOD, 1)).about["traceback"]


def test_what_does_not_fit_is_refused(run, whole, scenes, tmp_path):
    with pytest.raises(ValueError, match="unknown method 'clasifier', expected one of classifier, voxel_cl"):
        run(tmp_path / "a", methods=("clasifier",))
    with pytest.raises(ValueError, match="learned_recovery' needs models of kind classifier, recovery;"):
        run(tmp_path / "a", methods=("learned_recovery",))
    with pytest.raises(ValueError, match="no methods were named"):
        run(tmp_path / "a", methods=())
    with pytest.raises(ValueError, match="trials is 8, expected 1 to 7"):
        run(tmp_path / "a", trials=8)
    with pytest.raises(ValueError, match="trials is 0"):
        run(tmp_path / "a", trials=0)
    with pytest.raises(ValueError, match="holds scenes of toy, not of rope_dragging"):
        evaluate("rope_dragging", methods=("oracle",), out=tmp_path / "a", scenes=scenes)
    with pytest.raises(FileNotFoundError, match="no folder of models"):
        run(tmp_path / "a", models=tmp_path / "none")
    assert not (tmp_path / "a").exists(), "nothing was written"

    with pytest.raises(ValueError, match=r"holds another evaluation .*\n  seed: 0 -> 1\n"):
        run(whole, seed=1)
    shutil.copytree(whole, tmp_path / "older")
    config = tmp_path / "older" / "config.json"
    config.write_text(config.read_text().replace(TOY.scene.digest, "0123456789abcdef"))
    with pytest.raises(ValueError, match=r'\n  scene: "0123456789abcdef" -> '):
        run(tmp_path / "older")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "notes.txt").touch()
    with pytest.raises(ValueError, match=r"holds no evaluation but notes.txt"):
        run(tmp_path / "b")


def test_models_and_scenes_that_come_along_are_found_without_being_named(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="trials is 0, expected 1 to 150"):  # and no model is missing
        evaluate("rope_dragging", methods=("classifier",), out=out, trials=0)
    with pytest.raises(ValueError, match="trials is 0, expected 1 to "):
        evaluate(
            "rope_dragging", methods=("classifier",), out=out, trials=0, scenes=Path("rope_dragging_dense")
        )
    with pytest.raises(
        FileNotFoundError,
        match=r"no file of scenes dual_griper.*come: dual_gripper, dual_gripper_dense, .*, engine_bay, ",
    ):
        evaluate("dual_gripper", methods=("classifier",), out=out, scenes=Path("dual_griper"))
    assert not out.exists()


def test_a_file_goes_before_a_set_of_the_same_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = FOLDER / "rope_dragging.scenes"
    assert scene_file(None, "rope_dragging") == shipped
    assert scene_file(Path("rope_dragging"), "rope_dragging") == shipped
    Path("rope_dragging.scenes").touch()
    assert scene_file(Path("rope_dragging.scenes"), "rope_dragging") == Path("rope_dragging.scenes")
    assert scene_file(None, "rope_dragging") == shipped, "what lies about is not taken unasked"


def test_every_call_of_an_evaluation_is_noted_once(run, scenes, tmp_path):
    out = run(tmp_path / "out", trials=1)
    run(out, trials=1)
    (noted,) = noted_commands(out)
    ((function, arguments),) = parsed(noted.command)
    assert function is evaluate and arguments["out"] == out and arguments["scenes"] == scenes
    assert arguments["planning"] == PLANNING and arguments["budget"] == SETTINGS
    assert (arguments["trials"], arguments["side_by_side"]) == (1, 3)
    assert noted.inputs == {"scenes": digest(scenes)}


def test_every_recipe_is_made_of_what_exists():
    assert METHODS.keys() & RECIPES.keys() >= {"classifier", "no_classifier", "oracle", "random_recovery"}
    for recipe in RECIPES.values():
        assert recipe.recovery is None or recipe.reliability == "classifier"
