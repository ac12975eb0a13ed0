"""Evaluation scenes are none that models learned from, and where they are, it is said."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.datasets.collect import collect
from doojax.datasets.store import Dataset
from doojax.experiments.trials.evaluate import evaluate
from doojax.experiments.trials.methods import find_models, make_method
from doojax.experiments.trials.plan import plan
from doojax.experiments.trials.scenes import draw_scenes, save_scenes
from doojax.experiments.trials.seen import check_unseen, warning_of
from doojax.learning.checkpoints import Header, save_model
from doojax.learning.presets import classifier_preset, dynamics_preset
from doojax.learning.provenance import SAW, saw_scenes, seen_data
from doojax.models.builders import BUILDERS
from doojax.tasks import TASKS, make_task
from doojax.types import Transition

from .toy_trials import PLANNING, SETTINGS, SIMULATOR, TOY

SCENES = {"stream": "scenes/toy/easy", "seed": 3}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name != "toy"))
        for name in sorted(set(TASKS) - {"planar_pushing", "watering"})  # without trials; dear
    ],
)
@pytest.mark.parametrize("seed", [0, 2**32])
def test_scenes_for_trials_are_no_scenes_of_a_collection(name, seed, tmp_path):
    """Whichever seed both have. 64 trajectories: as many as scenes are drawn at once, to find hard ones."""
    if seed and name != "toy":
        pytest.skip("one seed is enough where scenes are dear")
    collect(name, trajectories=64, states=2, engine="mujoco", seed=seed, out=tmp_path / "data")
    stored = Dataset.open(tmp_path / "data")
    drawn = draw_scenes(make_task(name), 3, seed)
    for ours, theirs in (
        (drawn.starts.qpos, stored["initial_qpos"][:]),
        (drawn.starts.obstacle_position, stored["body_position"][:]),
    ):
        one, other = np.asarray(ours).reshape(3, -1), theirs.reshape(64, -1)
        moved = np.ptp(other, axis=0) > 1e-6  # the toy's wall and a task's table stand where they stand
        if moved.any():
            distance = np.abs(one[:, None, moved] - other[None, :, moved]).max(-1)
            assert distance.min() > 1e-3


def models(folder, saw, **about):
    """Untrained models of the toy task whose headers tell what they saw."""
    networks = {
        kind: preset("quick", TOY).network
        for kind, preset in (("dynamics", dynamics_preset), ("classifier", classifier_preset))
    }
    for kind, network in networks.items():
        config = {**vars(network), **({"members": 1} if kind == "dynamics" else {})}
        told = {**({SAW: saw} if saw is not None else {}), "threshold_m": 0.01, **about}
        save_model(folder / f"{kind}.eqx", Header(kind, "toy", config, told), BUILDERS[kind](config))
    return find_models(folder, "toy")


def test_a_collection_and_all_that_learns_from_it_say_which_scenes_they_saw(tmp_path):
    for phase in ("unconstrained", "constrained"):
        collect("toy", phase=phase, trajectories=3, states=2, seed=5, out=tmp_path / phase)
    free, cluttered = (Dataset.open(tmp_path / phase) for phase in ("unconstrained", "constrained"))
    (first,) = seen_data([free])
    assert (first["stream"], first["seed"]) == ("collect/toy/unconstrained", 5)
    assert first["trajectories"] == 3 and first["scene"] == TOY.scene.digest
    dynamics = Header("dynamics", "toy", {}, {SAW: [first]})
    both = seen_data([cluttered], [dynamics, dynamics])
    assert [entry["stream"] for entry in both] == ["collect/toy/constrained", "collect/toy/unconstrained"]
    classifier = Header("classifier", "toy", {}, {SAW: both})
    assert saw_scenes(classifier, "collect/toy/unconstrained", 5) is True
    assert saw_scenes(classifier, "collect/toy/unconstrained", 6) is False
    unknown = Header("dynamics", "toy", {}, {})
    assert saw_scenes(unknown, "scenes/toy/easy", 0) is None
    doubtful = Header("classifier", "toy", {}, {SAW: seen_data([cluttered], [unknown])})
    assert saw_scenes(doubtful, "scenes/toy/easy", 0) is None


def test_seen_scenes_are_refused_or_marked(tmp_path):
    found = models(tmp_path, [SCENES])
    with pytest.raises(ValueError, match=r"saw the scenes of stream scenes/toy/easy, seed 3, in training"):
        check_unseen("scenes/toy/easy", 3, found)
    assert check_unseen("scenes/toy/easy", 3, found, allow_seen=True) == "yes"
    assert "no evidence" in str(warning_of("yes", "classifier"))
    for stream, seed in (("scenes/toy/easy", 4), ("scenes/toy/dense", 3)):
        assert check_unseen(stream, seed, found) == "no"
    assert warning_of("no", "classifier") is None


def test_models_that_do_not_say_what_they_saw_are_marked(tmp_path):
    found = models(tmp_path, None)
    assert check_unseen("scenes/toy/easy", 3, found) == "unknown"
    assert "does not say which data it saw" in str(warning_of("unknown", "classifier"))


def test_evaluate_and_plan_refuse_scenes_that_a_model_saw(tmp_path, capsys):
    models(tmp_path / "models", [SCENES, {"stream": "plan", "seed": 8}])
    drawn = draw_scenes(TOY, 2, 3)  # whose goals are reached at once, so that nothing need be planned
    goals = eqx.tree_at(lambda g: g.tolerance, drawn.goals, np.full(2, 9.0, np.float32))
    save_scenes(tmp_path / "toy.scenes", replace(drawn, goals=goals))
    options = {"models": tmp_path / "models", "planning": PLANNING, "budget": SETTINGS}
    common = {"methods": ("classifier",), "scenes": tmp_path / "toy.scenes", **options}
    with pytest.raises(ValueError, match=r"draw others by doojax scenes --seed, or mark the results"):
        evaluate("toy", out=tmp_path / "out", **common)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="saw the scenes of stream plan, seed 8"):
        plan("toy", seed=8, out=tmp_path / "plan.npz", **options)
    evaluate("toy", out=tmp_path / "out", side_by_side=2, allow_seen=True, **common)
    assert '"scenes_seen": "yes"' in (tmp_path / "out" / "classifier" / "method.json").read_text()
    assert "its results are no evidence" in capsys.readouterr().err


def test_a_conformal_threshold_is_what_a_classifier_must_say(tmp_path):
    found = models(tmp_path, [], conformal_thresholds={"0.05": 0.83})
    plain = make_method("classifier", TOY, SIMULATOR, found)
    strict = make_method("classifier", TOY, SIMULATOR, found, "conformal:0.05")
    assert plain.error_threshold_m == strict.error_threshold_m == 0.01
    state = SIMULATOR.reset(jax.random.key(0))
    rope, obstacles = SIMULATOR.observe(state), SIMULATOR.obstacles(state)
    step = Transition(rope, jnp.zeros((1, 3)), rope, jnp.zeros(()))
    for judge, threshold in ((plain.reliability, 0.5), (strict.reliability, 0.83)):
        judged = eqx.filter_jit(judge)(obstacles, step)
        assert bool(judged.accepted) == (float(judged.score) > threshold)
    assert strict.reliability.threshold == 0.83
    assert judged.score == eqx.filter_jit(plain.reliability)(obstacles, step).score
    for text in ("conformal:0.2", "0.05", "probability:0.05"):
        with pytest.raises(ValueError, match=r"expected one of those that .* has: conformal:0.05"):
            make_method("classifier", TOY, SIMULATOR, found, text)
    checker = make_method("collision_checker", TOY, SIMULATOR, found, "conformal:0.05")
    assert checker.reliability.margin == 0.02


def test_a_collision_checker_keeps_the_margin_that_is_asked_for():
    checker = make_method("collision_checker", TOY, SIMULATOR, {}, margin=0.035)
    assert checker.reliability.margin == 0.035
    assert make_method("collision_checker", TOY, SIMULATOR, {}, margin=0.0).reliability.margin == 0.0
    for margin in (-0.01, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"margin is {margin}, expected metres, at least 0"):
            make_method("collision_checker", TOY, SIMULATOR, {}, margin=margin)
