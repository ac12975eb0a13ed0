"""Iterations of trials and learning: what is kept, what is gone on with, what is held out."""

import json
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.online.learners import Lesson, Stationary
from doojax.experiments.online.reliability import ReliabilityLearner
from doojax.experiments.online.runner import PURPOSE, evaluations, run_seed, training_scenes
from doojax.experiments.online.summary import read_curves, rows_of, table_of
from doojax.experiments.trials.evaluate import attempted
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.scenes import draw_scenes, load_scenes, save_scenes
from doojax.learning.checkpoints import load_model
from doojax.learning.fit import member
from doojax.learning.provenance import saw_scenes
from doojax.learning.runs import RunDirectory
from tests.experiments.trials.toy_trials import METHODS, TOY

from .toy_online import held_out, learner, made_trials, run, setting

ITERATIONS = 3
ATTEMPTED = "doojax.experiments.online.runner.attempted"
LEARNED = ReliabilityLearner.learned


def counted(self, known, seed, iteration):
    """In place of training: another bias for every number of examples."""
    count = int(np.asarray(known.buffer.weight).sum())
    if not count:
        return LEARNED(self, known, seed, iteration)
    models = eqx.tree_at(lambda m: m.embed.bias, known.models, replace_fn=lambda bias: bias + 1e-3 * count)
    figures = {"examples": count, "wrong_share": 0.0, "loss": 0.0, "balanced_accuracy": 0.0}
    return Lesson(known._replace(models=models), figures)


@pytest.fixture(scope="module", autouse=True)
def trials_are_made():
    """Neither a search nor training is compiled, but in the slow test."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(ATTEMPTED, made_trials)
        patched.setattr(ReliabilityLearner, "learned", counted)
        yield


@pytest.fixture(scope="module")
def heard():
    return []


@pytest.fixture(scope="module")
def whole(tmp_path_factory, heard, trials_are_made):
    """A run that nothing interrupted, laid out as the command does."""
    out = tmp_path_factory.mktemp("online") / "classifier" / "seed_0"
    return run(out, ITERATIONS, tell=heard.append)


def contents(folder):
    """All that must be the same bytes: not how long it took."""
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "seconds.jsonl"
    }


def test_every_iteration_has_its_trials_its_model_and_its_line(whole, heard):
    lines = RunDirectory(whole / "learning").metrics
    assert [line["epoch"] for line in lines] == [1, 2, 3]
    for iteration in range(1, ITERATIONS + 1):
        here = whole / f"iteration_{iteration:03d}"
        records = [load_record(here / f"{number:05d}.npz") for number in range(3)]
        assert [record.about["trial"] for record in records] == [3 * (iteration - 1) + n for n in range(3)]
        reached = np.mean([record.reached for record in records])
        assert lines[iteration - 1]["success_training"] == pytest.approx(reached, abs=1e-6)
        load_model(here, task="toy", kind="classifier")
    assert [one.iteration for one in evaluations(whole)] == [0, 2]
    assert (
        lines[1]["success_held_out"] == lines[2]["success_held_out"] == round(evaluations(whole)[1].rate, 6)
    )
    assert lines[2]["examples"] > lines[0]["examples"] > 0
    assert any(text.startswith("iteration 3: success_training") for text in heard)


class Killed(Exception):
    pass


def killed(self, folder, known, saw):
    raise Killed


@pytest.mark.slow
def test_real_trials_go_on_to_the_same_bytes_and_learn_from_augmentations(tmp_path, monkeypatch):
    monkeypatch.setattr(ATTEMPTED, attempted)
    monkeypatch.setattr(ReliabilityLearner, "learned", LEARNED)
    one, other = tmp_path / "one", tmp_path / "other"
    run(one, ITERATIONS, learner("augmentation"))
    with monkeypatch.context() as patched:
        patched.setattr(ReliabilityLearner, "save", killed)
        with pytest.raises(Killed):
            run(other, ITERATIONS, learner("augmentation"))
    run(other, ITERATIONS, learner("augmentation"))
    assert contents(one) == contents(other)
    lines = RunDirectory(one / "learning").metrics
    assert all(line["new_made"] > 0 and line["new_right"] > 0 for line in lines)


def test_killed_at_any_place_it_goes_on_to_the_same_bytes(whole, tmp_path, monkeypatch):
    """Twice: before a model is written, when the trials are there; and while a line is written."""
    out = tmp_path / "seed_0"
    run(out, 1)
    with monkeypatch.context() as patched:
        patched.setattr(ReliabilityLearner, "save", killed)
        with pytest.raises(Killed):
            run(out, ITERATIONS)
    assert (out / "iteration_002" / "00002.npz").exists()
    assert not (out / "iteration_002" / "model.eqx").exists()
    for name in ("learning/metrics.jsonl", "evaluations.jsonl", "seconds.jsonl"):
        with (out / name).open("a") as file:
            file.write('{"epoch": 2, "succ')
    run(out, ITERATIONS)
    assert contents(out) == contents(whole)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    run(out, ITERATIONS)  # nothing is left to do
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")} == before


def test_a_folder_of_another_run_is_refused(whole):
    with pytest.raises(ValueError, match=r"holds another run .*\n  episodes: 3 -> 2"):
        run(whole, ITERATIONS, episodes=2)
    with pytest.raises(ValueError, match="seed: 0 -> 1"):
        run_seed(whole, setting(), learner(), 1, ITERATIONS, print)


def test_nobody_trains_on_held_out_scenes(whole, tmp_path):
    """Whatever the seeds: scenes come from streams of other names, and so do the trials' random numbers."""
    mine = training_scenes(setting(), 0, ITERATIONS)
    others = held_out()
    assert (mine.stream, others.stream) == ("online/toy/easy", "scenes/toy/easy")
    assert len(mine) == 9
    gaps = np.abs(np.asarray(mine.starts.qpos)[:, None] - np.asarray(others.starts.qpos)[None]).max(-1)
    assert gaps.min() > 1e-3
    fewer = training_scenes(setting(), 0, 1)  # a longer run begins with the same
    assert np.array_equal(fewer.starts.qpos, np.asarray(mine.starts.qpos)[:3])
    starts = {load_record(path).points[0].tobytes() for path in whole.glob("iteration_*/*.npz")}
    tried = {load_record(path).points[0].tobytes() for path in whole.glob("evaluation_*/*.npz")}
    assert len(starts) == 9 and len(tried) == 3 and not starts & tried
    _, header = load_model(whole / "iteration_001")
    assert saw_scenes(header, "online/toy/easy", 0) and not saw_scenes(header, "scenes/toy/easy", 0)
    save_scenes(tmp_path / "a.scenes", draw_scenes(TOY, 1, 0, purpose=PURPOSE))
    drawn = load_scenes(tmp_path / "a.scenes")
    with pytest.raises(ValueError, match="come from online/toy/easy, from which one trains"):
        run(tmp_path / "out", 1, held_out=drawn, evaluation_trials=1)


def test_who_learns_nothing_is_evaluated_once(tmp_path):
    method = replace(METHODS["no_classifier"], reliability=member(learner().fresh(0).models, 0))
    out = run(tmp_path / "no_classifier" / "seed_0", 5, Stationary(method))
    assert [one.iteration for one in evaluations(out)] == [0]
    assert not list(out.glob("iteration_*"))
    (curve,) = read_curves(tmp_path)
    assert curve.stationary and curve.held_out.shape == (1, 1)
    (one,) = rows_of("toy", curve)
    assert one.tags == {"task": "toy", "method": "no_classifier", "iteration": 0, "evaluation": "held_out"}


def test_rows_say_what_the_records_say(whole):
    (curve,) = read_curves(whole.parents[1])
    assert curve.method == "classifier" and curve.seeds == (0,)
    assert curve.evaluated.tolist() == [0, 2] and curve.training.shape == (1, 3)
    rows = {
        (row.metric, row.tags.get("iteration"), row.tags.get("evaluation")): row
        for row in rows_of("toy", curve)
    }
    for iteration in (0, 2):
        records = [load_record(path) for path in whole.glob(f"evaluation_{iteration:03d}/*.npz")]
        share = np.mean([record.reached for record in records])
        assert rows["success_rate", iteration, "held_out"].value == pytest.approx(share)
    own = [load_record(path).reached for n in (1, 2) for path in whole.glob(f"iteration_{n:03d}/*.npz")]
    assert rows["success_rate", 2, "training"].value == pytest.approx(np.mean(own))
    lines = [json.loads(line) for line in (whole / "seconds.jsonl").read_text().splitlines()]
    assert rows["iteration_s", None, None].value == pytest.approx(
        np.median([line["trials"] + line["learning"] for line in lines])
    )
    assert table_of("toy", [curve]).row_count == 1


def test_an_iteration_without_a_plan_is_told_and_does_not_end_the_run(tmp_path, monkeypatch):
    """Nothing is found, nothing is executed, nothing learned; the next iteration goes on."""
    monkeypatch.setattr(ATTEMPTED, unmoved)
    heard = []
    out = run(tmp_path / "out", 2, tell=heard.append)
    assert "iteration 1: nothing was executed, so there is nothing to learn from" in heard
    assert "iteration 1: there are no examples yet: the classifier stays untrained" in heard
    lines = RunDirectory(out / "learning").metrics
    assert [line["examples"] for line in lines] == [0, 0]
    models = [load_model(out / f"iteration_{n:03d}")[0] for n in (1, 2)]
    assert all(map(np.array_equal, *map(jax.tree.leaves, models)))


def unmoved(task, simulator, method, planning, budget, trials, keep_trees=False):
    """Trials in which no plan was found: the records end where they begin."""
    nobody = trials._replace(wanted=[False] * len(trials.numbers))
    return made_trials(task, simulator, method, planning, budget, nobody)


def test_seeds_begin_with_other_classifiers_and_a_seed_always_with_the_same():
    one, again, other = (learner().fresh(seed).models for seed in (0, 0, 1))
    leaves = [
        jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(tree.embed)])
        for tree in (one, again, other)
    ]
    assert np.array_equal(leaves[0], leaves[1]) and not np.allclose(leaves[0], leaves[2])
