"""A task of another package, which is no rope, goes the whole way by the code that ropes go."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.datasets.collect import collect
from doojax.datasets.store import Dataset
from doojax.experiments.trials.evaluate import evaluate
from doojax.experiments.trials.outcomes import read_evaluation
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.replay import replay
from doojax.experiments.trials.scenes import SceneSet, save_scenes
from doojax.experiments.trials.setting import Method, Trials, TrialSettings
from doojax.experiments.trials.trial import run_trials
from doojax.goals import goal_of
from doojax.learning.data import load_split
from doojax.learning.fit import FitConfig, fit
from doojax.learning.labels import LabelConfig, label
from doojax.learning.losses import DynamicsProblem, errors
from doojax.models import Always, CollisionChecker, Conjunction
from doojax.models.ensemble import Ensemble
from doojax.planning import RrtSettings
from doojax.tasks import Task, make_task
from doojax.tasks.base import observed

from .pushing_task import Pushed

pytestmark = pytest.mark.slow
PLANNING = RrtSettings(lanes=16, extensions=1600, duration=6, candidates=8)
BUDGET = TrialSettings(searches=6, actions=60)
COUNT = 4


@pytest.fixture(scope="module", autouse=True)
def known(tmp_path_factory):
    """The task as a package's that pip has installed."""
    about = tmp_path_factory.mktemp("installed") / "pushing_task-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: pushing-task\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[doojax.tasks]\npushing = tests.experiments.trials.pushing_task:Pushing.of\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(about.parent)
        yield


def scenes():
    """Starts, and goals 15 cm behind the cylinder as the hand sees it."""
    task = make_task("pushing")
    simulator = task.simulator("mujoco")
    starts = jax.jit(jax.vmap(simulator.reset))(jax.random.split(jax.random.key(3), COUNT))
    seen = observed(simulator, starts)
    away = (seen.positions[:, 0] - seen.hand).at[:, 2].set(0.0)
    places = seen.positions[:, 0] + 2.5 * away
    return starts, jax.vmap(lambda place: goal_of([place], [[0]], 2, task.goal_threshold))(places)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pushing")
    for phase, count in (("unconstrained", 512), ("constrained", 64)):
        collect("pushing", phase=phase, trajectories=count, engine="mujoco", out=folder / phase)
    save_scenes(folder / "pushing.scenes", SceneSet("pushing", 5, *scenes(), {}))
    return folder


@pytest.fixture(scope="module")
def learned(folder):
    data = Dataset.open(folder / "unconstrained")
    problem = DynamicsProblem(
        load_split(data, "train"), load_split(data, "validation"), 64, False, network=Pushed
    )
    return Ensemble(fit(problem, FitConfig(400, 32, members=3, learning_rate=3e-3), seed=0))


def test_what_is_collected_can_be_learned(folder, learned):
    assert isinstance(make_task("pushing"), Task)
    data = Dataset.open(folder / "unconstrained")
    assert {"positions", "velocities", "hand", "actions"} <= set(data.fields)
    unseen = load_split(data, "calibration")
    error = jax.jit(jax.vmap(lambda one: errors(learned, one)[1]))(unseen)[:, -1].mean()
    moved = jnp.linalg.norm(unseen.states.positions[:, -1, 0] - unseen.states.positions[:, 0, 0], axis=-1)
    assert float(error) < 0.4 * float(moved.mean())  # of what it errs that believes that nothing moves


def test_where_the_model_holds_is_labelled(folder, learned):
    """The model has seen no post: where a hand or the cylinder meets one it errs."""
    data = load_split(Dataset.open(folder / "constrained"), "train")
    found = label(learned, data, LabelConfig(start_every=1, horizon=1))
    near = jax.jit(jax.vmap(CollisionChecker().distance))(
        jax.tree.map(lambda leaf: leaf[found.trajectory], data.obstacles), found.transition
    )
    assert len(found) == len(data) * 5
    assert np.isfinite(found.error).all() and float(found.transition.uncertainty.max()) > 0
    assert near.shape == found.error.shape


def test_it_is_planned_with_what_was_learned(learned):
    task = make_task("pushing")
    simulator = task.simulator("mujoco")
    starts, goals = scenes()
    method = Method("learned", learned, Conjunction((CollisionChecker(0.03), Always())))
    records = run_trials(task, simulator, method, PLANNING, BUDGET, Trials(starts, goals, range(COUNT)))
    assert sum(record.reached for record in records) >= COUNT - 1
    begun = [np.linalg.norm(record.points[0, 0] - record.goal) for record in records]
    assert min(begun) > task.goal_threshold
    np.testing.assert_allclose(replay(simulator, records[0]), records[0].points, atol=1e-6)


def test_methods_are_compared_by_the_command(folder):
    evaluate(
        "pushing",
        methods=("oracle",),
        scenes=folder / "pushing.scenes",
        out=folder / "trials",
        engine="mujoco",
        planning=replace(PLANNING, extensions=320),
        budget=TrialSettings(searches=2, actions=20),
        side_by_side=COUNT,
    )
    _, (outcomes,) = read_evaluation(folder / "trials")
    assert len(outcomes.trials) == COUNT and np.isfinite(outcomes.error).all()
    record = load_record(folder / "trials" / "oracle" / "00000.npz")
    assert record.task == "pushing" and record.points.shape[1:] == (1, 3)
