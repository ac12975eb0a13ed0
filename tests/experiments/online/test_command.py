"""`doojax online`: what it is given, what it writes, what it refuses."""

from pathlib import Path

import pytest

from doojax.commands import parsed
from doojax.experiments.online.command import METHODS, online
from doojax.experiments.reports.summary import read_summary
from doojax.experiments.trials.scenes import draw_scenes, save_scenes
from tests.experiments.trials.toy_trials import PLANNING, SETTINGS, TOY


@pytest.fixture(scope="module")
def common(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "toy.scenes"
    save_scenes(path, draw_scenes(TOY, 3, 0))
    return {"scenes": path, "evaluation_trials": 2, "planning": PLANNING, "budget": SETTINGS}


@pytest.mark.slow
def test_competitors_that_learn_nothing_are_measured_and_published_with_their_command(
    common, tmp_path, capsys
):
    out, results = tmp_path / "out", tmp_path / "results"
    online("toy", methods=("collision_checker",), out=out, seeds=(0, 1), publish=results, **common)
    assert "collision_checker" in capsys.readouterr().out
    assert (out / "success.png").stat().st_size > 5000
    summary = read_summary(results / "summary.json")
    (row,) = summary.rows
    assert row.metric == "success_rate" and row.n == 2 and 0 <= row.value <= 1
    assert row.tags["iteration"] == 0 and row.tags["evaluation"] == "held_out"
    ((function, arguments),) = parsed(summary.runs[0].command)
    assert function is online and arguments["seeds"] == (0, 1) and arguments["scenes"] == common["scenes"]
    assert set(summary.runs[0].inputs) == {"scenes"}


def test_what_cannot_be_run_is_refused(common, tmp_path):
    def run(**changes):
        online("toy", **{"methods": ("classifier",), "out": tmp_path / "out", **common, **changes})

    with pytest.raises(
        ValueError, match="methods are clasifier, expected some of classifier, classifier_aug"
    ):
        run(methods=("clasifier",))
    with pytest.raises(
        ValueError, match="classifier begins with trained dynamics, and there are none for toy"
    ):
        run()
    with pytest.raises(ValueError, match="iterations is 0, expected at least 1"):
        run(iterations=0)
    with pytest.raises(ValueError, match=r"seeds are \(1, 1\), expected one or more, none of them twice"):
        run(seeds=(1, 1))
    with pytest.raises(ValueError, match="evaluation_trials is 4, expected 1 to 3, the scenes"):
        run(evaluation_trials=4)
    with pytest.raises(FileNotFoundError, match="no file of scenes"):
        run(scenes=Path("elsewhere.scenes"))
    assert not (tmp_path / "out").exists()


def test_the_help_names_every_method():
    assert all(name in str(online.__doc__) for name in METHODS)
