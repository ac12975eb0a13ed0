"""Dynamics that adapt online, by hand-made trials of the toy task."""

from dataclasses import asdict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.online.focus import FocusLearner, FocusSettings, divided
from doojax.learning.adaptation import AdaptationMethod
from doojax.models import Always
from doojax.models.deviation import DeviationEstimator
from doojax.models.dynamics import DynamicsConfig, UnconstrainedDynamics
from doojax.models.ensemble import Ensemble
from tests.experiments.trials.toy_trials import TOY

from .toy_online import record

LIMIT = 0.02  # m
NETWORK = DynamicsConfig(points=5, grippers=1, origin="gripper", width=16, depth=1)
FIGURES = {"transitions", "similar", "deviation_m", "estimate_off_m"}
SETTINGS = FocusSettings(
    steps=150, epochs=1, learning_rate=1e-2, deviation_steps=20, deviation_epochs=1, capacity=64
)


def learner(name: AdaptationMethod = "all_data", gamma=1.0, estimated=True):
    """Two untrained networks that are the source's."""
    keys = jax.random.split(jax.random.key(0), 2)
    source = Ensemble(eqx.filter_vmap(lambda key: UnconstrainedDynamics(NETWORK, key=key))(keys))
    config = {**asdict(NETWORK), "members": 2}
    return FocusLearner(name, TOY, source, config, gamma, LIMIT, name, estimated, SETTINGS)


@pytest.fixture(scope="module")
def learned():
    """All data count: what is known at first, after two trials, and what was said and measured."""
    one = learner()
    fresh = one.fresh(0)
    taken = one.taken(fresh, [record(6), record(0), record(4)], 0, 1)
    return one, fresh, taken, one.learned(taken.known, 0, 1)


@pytest.mark.slow
def test_dynamics_adapt_to_what_was_executed_and_an_estimator_judges_them(learned):
    one, fresh, taken, lesson = learned
    assert taken.figures == {"new_transitions": 10} and len(taken.known.trajectories) == 2
    assert set(lesson.figures) == FIGURES and lesson.figures["transitions"] == 10
    assert isinstance(one.method(fresh).reliability, Always)
    judge = one.method(lesson.known).reliability
    assert isinstance(judge, DeviationEstimator) and float(judge.limit) == pytest.approx(LIMIT)
    assert lesson.known.seen == 150 * 32 * 5  # pieces of five steps
    first = record(6)
    state = jax.tree.map(lambda leaf: leaf[0, 0], taken.known.trajectories[0].states)
    action = jnp.asarray(first.replay["actions"][0])
    predicted = [known.dynamics(None, state, action)[0].points for known in (fresh, lesson.known)]
    errors = [float(jnp.abs(points - first.points[1]).max()) for points in predicted]
    assert errors[1] < errors[0] / 2


@pytest.mark.slow
def test_what_is_saved_is_what_is_known(learned, tmp_path):
    one, _, taken, lesson = learned
    one.save(tmp_path, lesson.known, [])
    read = one.restored(tmp_path, taken.known)
    for mine, theirs in ((read.dynamics, lesson.known.dynamics), (read.deviation, lesson.known.deviation)):
        for left, right in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_array_equal(left, right)
    assert read.seen == lesson.known.seen and len(read.trajectories) == 2
    again, here = one.learned(read, 0, 2), one.learned(lesson.known, 0, 2)
    for left, right in zip(jax.tree.leaves(again.known), jax.tree.leaves(here.known), strict=True):
        np.testing.assert_array_equal(left, right)  # a resumed run goes on to the same bits


def test_without_data_the_dynamics_stay_the_sources():
    one = learner()
    taken = one.taken(one.fresh(0), [record(0)], 0, 1)
    lesson = one.learned(taken.known, 0, 1)
    assert taken.told == ("nothing was executed, so there is nothing to learn from",)
    assert lesson.told == ("there are no data yet: the dynamics stay the source's",)
    assert set(lesson.figures) == FIGURES and lesson.known.dynamics is one.source


def test_where_nothing_is_similar_that_is_told_and_without_an_estimator_all_is_accepted():
    one = learner("focus", gamma=1e-6, estimated=False)
    taken = one.taken(one.fresh(0), [record(6)], 0, 1)
    lesson = one.learned(taken.known, 0, 1)
    assert lesson.figures["similar"] == 0.0
    assert "no transition has an error below gamma = 1e-06 m" in lesson.told[0]
    assert isinstance(one.method(lesson.known).reliability, Always)


def test_settings_that_learn_nothing_are_refused():
    with pytest.raises(ValueError, match="deviation_epochs is 0, expected at least 1"):
        FocusSettings(deviation_epochs=0)


def test_nothing_that_is_learned_from_chooses_or_calibrates_once_there_is_enough():
    assert divided([0, 1, 2]) == ([0, 1, 2], [0, 1, 2], ())
    assert divided([*range(6)]) == ([1, 2, 3, 4], [0, 5], ())  # one alone would calibrate nothing
    assert divided([*range(12)]) == ([2, 3, 4, 7, 8, 9], [0, 5, 10], [1, 6, 11])


def test_with_enough_trajectories_the_estimator_is_calibrated(learned):
    one, fresh, _, before = learned
    assert float(before.known.deviation.power) == 1.0 and float(before.known.deviation.shift) == 0.0
    many = one.taken(fresh, [record(2) for _ in range(11)], 0, 1).known
    judge = one.learned(many, 0, 1).known.deviation
    assert judge is not None and (float(judge.power), float(judge.shift)) != (1.0, 0.0)
    assert float(judge.limit) == pytest.approx(LIMIT)
