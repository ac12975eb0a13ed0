"""`doojax regrasp`: which trials are run, what is kept of them, and that they go on after a kill."""

from functools import cache

import numpy as np
import pytest
from rich.console import Console

from doojax.experiments.regrasping import command
from doojax.experiments.regrasping.command import (
    counts_of,
    load_trial,
    record_file,
    run_missing,
    seconds_file,
)
from doojax.experiments.regrasping.figures import rows_of
from doojax.experiments.regrasping.run import RegraspSettings, Seconds
from doojax.experiments.regrasping.scenes import save_arm_scenes, scenes_of
from doojax.experiments.regrasping.trial import Trial
from doojax.experiments.trials.records import Event
from doojax.simulation.scenes import obstacles_at
from tests.experiments.regrasping import scenes
from tests.records import record_of

SECONDS = Seconds(60.0, 90.0, 30.0, [{"planning": 90.0}])
REGRASP = {
    "changed": True,
    "candidates": [{}] * 45,
    "planned_signature": "{(1)}",
    "executed_signature": "{(0)}",
    "rope_off_mean": 0.01,
}


def trial(reached: bool, method: str = "signature", seconds: Seconds = SECONDS) -> Trial:
    """A trial of two states."""
    state = scenes.start().state
    record = record_of(
        np.zeros((2, 3, 3)),
        task="hanging",
        method=method,
        obstacles=obstacles_at(scenes.SCENE, state.obstacle_position, state.obstacle_quaternion),
        grippers=np.zeros((2, 2, 3)),
        events=(Event(1, "end", "so it was"),),
        reached=reached,
        about={"simulated_s": 120.0, "grasps": 2, "iterations": 7, "regrasps": [REGRASP]},
    )
    return Trial(record, seconds)


CONSOLE = Console(quiet=True)


@cache
def three():
    """Scenes."""
    return scenes_of(scenes.TASK, 0, [scenes.start()._replace(attempt=number) for number in range(3)])


@pytest.fixture
def ran(monkeypatch):
    """Which trials are run; a number is killed at."""
    done: list = []

    def fake(task, simulator, start, method, seed, number, settings):
        if (method, number) == ran_until[0]:
            raise KeyboardInterrupt
        assert start.attempt == number
        done.append((method, number))
        return trial(number == 0, method, Seconds(control=float(len(done))))

    ran_until = [None]
    monkeypatch.setattr(command, "run_trial", fake)
    return done, ran_until


def test_a_killed_run_goes_on_and_leaves_the_same_bytes(ran, tmp_path):
    done, until = ran
    counts = {"signature": 3, "nearest": 2}

    def run(out):
        return run_missing(scenes.TASK, three(), counts, 0, RegraspSettings(), out, CONSOLE)

    until[0] = ("nearest", 1)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "killed")
    until[0] = None
    before = list(done)
    found = run(tmp_path / "killed")
    assert done[len(before) :] == [("nearest", 1), ("signature", 2)]
    assert {name: len(own) for name, own in found.items()} == counts
    run(tmp_path / "whole")
    for method, count in counts.items():
        for number in range(count):
            files = [record_file(tmp_path / name, method, number) for name in ("killed", "whole")]
            assert files[0].read_bytes() == files[1].read_bytes()
    seconds = [seconds_file(tmp_path / name, "signature", 2).read_text() for name in ("killed", "whole")]
    assert seconds[0] != seconds[1]  # which are apart
    assert load_trial(tmp_path / "killed", "signature", 0).seconds == Seconds(control=1.0)


def test_scenes_are_counted_for_each_method():
    assert counts_of(("signature", "tamp5"), (), 25) == {"signature": 25, "tamp5": 25}
    assert counts_of(("signature", "tamp5"), (4,), 25) == {"signature": 4, "tamp5": 4}
    assert counts_of(("signature", "tamp5"), (25, 10), 25) == {"signature": 25, "tamp5": 10}
    with pytest.raises(ValueError, match="one for each of 2 methods"):
        counts_of(("signature", "tamp5"), (25, 10, 5), 25)
    with pytest.raises(ValueError, match="scenes is 26, expected 1 to 25"):
        counts_of(("signature",), (26,), 25)


def test_wrong_requests_are_refused_before_anything_is_made(tmp_path):
    out = tmp_path / "trials"
    with pytest.raises(
        ValueError, match="unknown method 'always_blocklist', expected some of signature, no_s"
    ):
        command.regrasp("threading", out=out, methods=("always_blocklist",))
    with pytest.raises(ValueError, match="no methods were named"):
        command.regrasp("pulling", out=out, methods=())
    assert not out.exists()


def test_figures_are_means_of_all_trials_and_tests_of_shared_scenes():
    quick = Seconds(6.0, 0.0, 0.0, [{"planning": 10.0}])
    found = {
        "signature": [trial(True)] * 5 + [trial(True, seconds=quick)],
        "tamp5": [trial(False, "tamp5")] * 4,
    }
    rows = {(row.metric, row.tags["method"]): row for row in rows_of("hanging", found)}
    assert rows["success_rate", "signature"].value == 1 and rows["success_rate", "tamp5"].value == 0
    assert rows["wall_min", "tamp5"].value == 3 and rows["plan_grasps_min", "tamp5"].value == 1.5
    assert rows["wall_min", "signature"].value == pytest.approx((5 * 3 + 0.1) / 6)
    assert rows["wall_of_success_min", "signature"].value == 3  # the median
    assert ("wall_of_success_min", "tamp5") not in rows
    assert rows["sim_min", "tamp5"].value == 2 and rows["grasps", "tamp5"].value == 2
    assert rows["plan_grasp_s", "tamp5"].value == 90 and rows["candidates_per_s", "tamp5"].value == 0.5
    assert rows["signature_as_planned", "tamp5"].value == 0
    assert rows["p_value", "signature"].value == pytest.approx(0.125)  # 4 of 4 pairs differ: 2 / 2^4
    assert rows["p_value", "signature"].n == 4


def test_the_hanging_task_has_the_methods_of_reaching():
    assert "wang" not in command.methods_of(scenes.TASK)


def test_a_folder_is_begun_gone_on_with_and_refused_for_other_trials(ran, tmp_path, monkeypatch, capsys):
    """Where no scenes come along, they are drawn into it; more of them begin with the same."""
    done, _ = ran
    drawn: list = []

    def draw(name, *, out, count, seed):
        drawn.append(count)
        starts = [scenes.start()._replace(attempt=number) for number in range(count)]
        save_arm_scenes(out, scenes_of(scenes.TASK, seed, starts))

    monkeypatch.setattr(command, "rows_of", lambda *_: [])  # of what these trials leave out
    monkeypatch.setattr(command, "task_of", lambda name: scenes.TASK)
    monkeypatch.setattr(command, "regrasp_scenes", draw)
    monkeypatch.setitem(command.COUNTS, scenes.TASK.name, 3)
    out = tmp_path / "trials"
    command.regrasp("untangling", out=out, scenes=(2,))
    command.regrasp("untangling", out=out, scenes=(2,))
    assert done == [("signature", 0), ("signature", 1)] and drawn == [2]
    command.regrasp("untangling", out=out, scenes=(3,))
    assert done[2:] == [("signature", 2)] and drawn == [2, 3]
    with pytest.raises(ValueError, match="holds another folder of trials"):
        command.regrasp("untangling", out=out, scenes=(2,), seed=1)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("x")
    with pytest.raises(ValueError, match="holds no folder of trials but mine"):
        command.regrasp("untangling", out=tmp_path / "notes", scenes=(2,))
    assert [path.name for path in (tmp_path / "notes").iterdir()] == ["mine.txt"] and len(drawn) == 2
