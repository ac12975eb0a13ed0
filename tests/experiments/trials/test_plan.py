"""The plan command: what it records, and the answers to bad input."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from doojax.commands import parsed
from doojax.experiments.trials.plan import plan
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.replay import replay
from doojax.experiments.trials.trial import NOT_EXECUTED
from doojax.tasks.toy import HEIGHT

from .toy_trials import PLANNING, SETTINGS, SIMULATOR

toy = partial(plan, "toy", planning=PLANNING, budget=SETTINGS)


def test_a_plan_is_executed_recorded_and_told(tmp_path, capsys):
    toy(method="oracle", seed=3, out=tmp_path / "plan.npz")
    record = load_record(tmp_path / "plan.npz")
    assert np.array_equal(replay(SIMULATOR, record), record.points)
    assert record.method == "oracle" and record.seed == 3
    assert (~record.plans[0].accepted).sum() >= 0 and len(record.plans[0].parent) > len(record.plans[0].path)
    said = capsys.readouterr().out
    assert f"{100 * record.about['final_error_m']:.1f} cm from the goal" in said
    assert all(event.kind in said for event in record.events)


def test_a_warning_about_models_is_words_without_markup(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "doojax.experiments.trials.plan.warning_of", lambda saw, method: f"{method} is [unknown]"
    )
    toy(method="oracle", execute=False, out=tmp_path / "plan.npz")
    assert "\noracle is [unknown]\n" in capsys.readouterr().out


def test_no_record_is_overwritten(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        toy(method="oracle", seed=3, execute=False)
    first, second = sorted(Path("plans").iterdir())
    assert (first.name, second.name) == ("toy_oracle_1.npz", "toy_oracle_2.npz")
    ((function, arguments),) = parsed(load_record(first).about["command"])
    assert function is plan and arguments["method"] == "oracle" and not arguments["execute"]
    assert arguments["planning"] == PLANNING
    before = first.read_bytes()
    with pytest.raises(FileExistsError, match="is there already: name another record by --out"):
        toy(method="oracle", out=first)
    assert first.read_bytes() == before


@pytest.mark.slow
def test_only_planned_nothing_moves_and_goals_may_be_combined(tmp_path):
    goal, gripper = (0.0, -0.45, HEIGHT), (-0.1, -0.4, HEIGHT)
    toy(
        method="oracle",
        goal=goal,
        points=(0, 1),
        grippers=(gripper,),
        execute=False,
        out=tmp_path / "plan.npz",
    )
    record = load_record(tmp_path / "plan.npz")
    assert record.end == NOT_EXECUTED and len(record.points) == 1
    assert record.goal == pytest.approx(goal) and record.about["more_targets"] == [pytest.approx(gripper)]
    chosen = record.plans[0].path[-1]
    ends, hand = record.plans[0].points[chosen][:2], record.plans[0].grippers[chosen][0]
    tail = np.linalg.norm(ends - np.array(goal), axis=-1).min()
    distance = max(tail, np.linalg.norm(hand - np.array(gripper)))
    start = max(
        np.linalg.norm(record.points[0, :2] - np.array(goal), axis=-1).min(),
        np.linalg.norm(record.grippers[0, 0] - np.array(gripper)),
    )
    assert distance < start / 2
    assert f"{100 * distance:.1f} cm from the goal" in record.events[0].text


def test_a_grippers_goal_is_drawn_from_the_gripper(tmp_path):
    """Not from the rope's last point, which for gripper 0 of two is the other end."""
    toy(method="oracle", grippers=((-0.1, -0.4, HEIGHT),), out=tmp_path / "plan.npz")
    record = load_record(tmp_path / "plan.npz")
    assert record.goal_point == record.points.shape[1]  # the first body behind the rope's points
    assert np.array_equal(record.goal_way, record.grippers[:, 0])
    missing = np.linalg.norm(record.goal_way[-1] - record.goal)
    assert missing == pytest.approx(record.about["final_error_m"], abs=1e-6)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"goal": (0.9, 0.0, HEIGHT)}, r"the goal \[0.9, 0.0, 0.05\] lies outside of the workspace of toy"),
        ({"grippers": ((0.0, -0.7, HEIGHT),)}, "lies outside of the workspace"),
        ({"grippers": ((0.0, 0.0, HEIGHT), (0.1, 0.0, HEIGHT))}, "2 positions for 1 grippers"),
        ({"goal": (0.2, 0.0, HEIGHT), "points": (5,)}, "expected some of the rope's points 0 to 4"),
        ({"points": (1,)}, "points were given without a goal"),
        ({"method": "magic"}, "unknown method 'magic', expected one of classifier"),
        ({"method": "voxel_classifier"}, "needs models of kind voxel_classifier; there are: none"),
        ({"out": "plan.json"}, "a record ends in .npz, got plan.json"),
    ],
)
def test_bad_input_is_answered_before_anything_is_done(options, expected, tmp_path):
    out = Path(options.pop("out", tmp_path / "plan.npz"))
    with pytest.raises(ValueError, match=expected):
        toy(**options, out=out)
    assert not out.exists()
