"""From data of the toy task to models that judge it: the whole chain, small."""

import errno
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from doojax import files
from doojax.commands import parsed
from doojax.datasets.collect import collect
from doojax.experiments.reports.provenance import digest, noted_commands
from doojax.experiments.reports.summary import read_summary
from doojax.experiments.training.evaluate import evaluate_model
from doojax.experiments.training.train import train
from doojax.experiments.trials.methods import make_method
from doojax.learning.checkpoints import load_model
from doojax.learning.runs import RunDirectory
from doojax.learning.train import train_dynamics
from doojax.tasks import make_task

STATES = 6


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("toy")
    for phase, count in (("unconstrained", 512), ("constrained", 1536)):
        collect("toy", phase=phase, trajectories=count, states=STATES, out=folder / phase)
    return folder


@pytest.fixture(scope="session")
def runs(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    train("dynamics", data=(data / "unconstrained",), out=folder / "dynamics", epochs=12)
    train(
        "classifier",
        data=(data / "constrained",),
        dynamics=folder / "dynamics",
        out=folder / "classifier",
        threshold=0.01,
        epochs=4,
    )
    return folder


def measured(folder):
    return {row.metric: row.value for row in read_summary(folder / "summary.json").rows}


@pytest.mark.slow
def test_a_full_disk_is_said_and_the_run_goes_on_when_there_is_room(data, tmp_path, monkeypatch):
    flush, full = files.flush, []

    def flush_unless_full(path):
        if ".eqx" in path.name:
            full.append(path)
        if len(full) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        flush(path)

    def run():
        train("dynamics", data=(data / "unconstrained",), out=tmp_path / "run", epochs=3)

    with monkeypatch.context() as patch:
        patch.setattr(files, "flush", flush_unless_full)
        with pytest.raises(OSError, match="no room left to write to"):
            run()
    run()
    assert [line["epoch"] for line in RunDirectory(tmp_path / "run").metrics] == [1, 2, 3]


def test_a_run_holds_config_environment_metrics_curves_and_model(runs):
    names = {path.name for path in (runs / "dynamics").iterdir()}
    assert {"config.json", "environment.json", "metrics.jsonl", "curves.png", "model.eqx"} <= names
    assert len((runs / "dynamics" / "metrics.jsonl").read_text().splitlines()) == 12
    config = json.loads((runs / "classifier" / "config.json").read_text())
    assert config["threshold_m"] == 0.01
    assert config["labels"]["horizon"] == 10


def test_a_run_says_by_which_command_it_was_trained(runs, data):
    (run,) = noted_commands(runs / "classifier")
    ((function, arguments),) = parsed(run.command)
    assert function is train
    assert arguments["data"] == (data / "constrained",) and arguments["out"] == runs / "classifier"
    assert arguments["threshold"] == 0.01
    assert run.inputs == {"data 1": digest(data / "constrained"), "dynamics": digest(runs / "dynamics")}


def test_the_dynamics_predict_the_toy_to_millimetres(runs, data, tmp_path):
    evaluate_model(str(runs / "dynamics"), data=data / "unconstrained", publish=tmp_path)
    (run,) = read_summary(tmp_path / "summary.json").runs
    assert parsed(run.command)[0][1]["publish"] == tmp_path
    assert run.inputs == {"model": digest(runs / "dynamics"), "data": digest(data / "unconstrained")}
    found = measured(tmp_path)
    assert found["dynamics_error_m"] < 0.008  # it moves 5 cm a step
    assert (tmp_path / "toy_dynamics_unconstrained.png").exists()


def test_the_classifier_knows_where_the_wall_is_and_nothing_else_does(runs, data, tmp_path):
    options = {"data": data / "constrained", "dynamics": runs / "dynamics"}
    evaluate_model(str(runs / "classifier"), **options, publish=tmp_path / "classifier")
    evaluate_model("always", **options, publish=tmp_path / "always")
    found, blind = measured(tmp_path / "classifier"), measured(tmp_path / "always")
    assert found["classifier_auroc"] > 0.9
    assert blind["classifier_auroc"] == 0.5
    assert blind["classifier_recall"] == 1
    assert blind["classifier_precision"] == pytest.approx(blind["right_fraction"])


@pytest.mark.slow
def test_deviations_are_known_better_than_by_their_median_and_bounded_as_promised(runs, data, tmp_path):
    options = {"data": data / "constrained", "dynamics": runs / "dynamics"}
    train(
        "deviation",
        data=(options["data"],),
        dynamics=options["dynamics"],
        out=tmp_path / "run",
        epochs=3,
        threshold=0.05,
    )
    model, header = load_model(tmp_path / "run", kind="deviation")
    assert float(model.limit) == pytest.approx(0.05) and header.about["threshold_m"] == 0.05
    files = {"dynamics": runs / "dynamics" / "model.eqx", "deviation": tmp_path / "run" / "model.eqx"}
    toy = make_task("toy")
    strict = make_method("deviation", toy, toy.simulator(), files, "conformal:0.1")
    assert float(strict.reliability.factor) == pytest.approx(header.about["conformal_factors"]["0.1"])
    with pytest.raises(
        ValueError, match=r"expected one of those that .* has: conformal:0\.05, conformal:0\.1"
    ):
        make_method("deviation", toy, toy.simulator(), files, "conformal:0.2")
    evaluate_model(str(tmp_path / "run"), **options, publish=tmp_path / "measured")
    rows = read_summary(tmp_path / "measured" / "summary.json").rows
    error = {row.tags["estimate"]: row.value for row in rows if row.metric == "mde_error"}
    assert error["network"] < 0.7 * error["constant"]
    covered = {row.tags["alpha"]: row.value for row in rows if row.metric == "mde_coverage"}
    assert covered[0.1] > 0.85 and covered[0.05] > 0.9
    assert (tmp_path / "measured" / "toy_deviation.png").exists()


def test_a_killed_training_ends_with_the_same_model(runs, data, tmp_path):
    def kill(number, epochs, metrics):
        if number == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_dynamics(data / "unconstrained", tmp_path / "run", "quick", 12, 0, kill)
    assert not (tmp_path / "run" / "model.eqx").exists()
    train("dynamics", data=(data / "unconstrained",), out=tmp_path / "run", epochs=12)
    again, whole = (load_model(path)[0] for path in (tmp_path / "run", runs / "dynamics"))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), again, whole))


def test_data_of_the_wrong_phase(runs, data, tmp_path):
    with pytest.raises(ValueError, match=r"phase 'constrained': unconstrained dynamics are learned from"):
        train("dynamics", data=(data / "constrained",), out=tmp_path / "run")
    with pytest.raises(ValueError, match=r"phase 'unconstrained': where predictions hold is learned from"):
        train(
            "classifier",
            data=(data / "unconstrained",),
            dynamics=runs / "dynamics",
            out=tmp_path / "run",
        )
    assert not (tmp_path / "run").exists()


def test_a_threshold_for_which_all_is_right(runs, data, tmp_path):
    with pytest.raises(ValueError, match=r"the train split has 0 wrong predictions at a threshold of 5 m"):
        train(
            "classifier",
            data=(data / "constrained",),
            dynamics=runs / "dynamics",
            out=tmp_path / "run",
            threshold=5.0,
        )


@pytest.mark.parametrize(
    ("what", "options", "message"),
    [
        ("classifier", {}, "name the dynamics' run by --dynamics"),
        ("deviation", {}, "a deviation judges predictions: name the dynamics' run by --dynamics"),
        ("recovery", {"dynamics": Path("x")}, "name its run by --classifier"),
        ("dynamics", {"threshold": 0.1}, "threshold is 0.1, but dynamics has none"),
        ("full_dynamics", {}, "learns from two data sets, one of each phase; 1 were named"),
    ],
)
def test_what_is_missing_is_named_before_anything_is_read(what, options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        train(what, data=(tmp_path / "none",), out=tmp_path / "run", **options)


def test_a_model_of_another_kind(runs, data, tmp_path):
    with pytest.raises(ValueError, match=r"a model of kind 'classifier', expected one of kind 'dynamics'"):
        train(
            "classifier",
            data=(data / "constrained",),
            dynamics=runs / "classifier",
            out=tmp_path / "run",
        )


def test_other_settings_in_a_finished_runs_folder(runs, data):
    with pytest.raises(ValueError, match=r"seed: 0 -> 1"):
        train("dynamics", data=(data / "unconstrained",), out=runs / "dynamics", epochs=12, seed=1)
