"""What is learned from a trial: labels by hand, classes that are missing, examples that are made."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.online.experience import executed, judged_by_outcome, trajectory_of
from doojax.experiments.online.reliability import ReliabilitySettings
from doojax.geometry.sdf import signed_distance
from doojax.learning.buffer import Buffer
from doojax.learning.buffered import class_weights, evenly
from doojax.learning.fit import member
from doojax.learning.labels import LabelConfig
from tests.experiments.trials.toy_trials import SETTINGS, SIMULATOR, TOY
from tests.planning.problems import Towed

from .toy_online import ERROR, SMALL, START, STEP, learner, record


def test_what_was_as_predicted_is_right_and_what_was_not_is_wrong():
    """The hand stops after four steps at a wall: predictions across it are off by a step, then by two."""
    config = LabelConfig(start_every=1, horizon=2)
    (trajectory,) = executed([record(6, stops_after=4)])
    found, keep = judged_by_outcome(Towed(), trajectory, ERROR, config, steps=10)
    begins = np.asarray(found.transition.state.grippers)[keep, 0, 0]
    right = np.asarray(found.right)[keep]
    # the step at 5 follows an error where it begins at 4, and is left out; there is none at 6
    steps = [0, 1, 1, 2, 2, 3, 3, 4, 4, 5]  # from states 0, 0, 1, 1, 2, 2, 3, 3, 4, 5
    assert begins == pytest.approx([START + STEP * min(step, 4) for step in steps], abs=1e-6)
    assert right.tolist() == [step < 4 for step in steps]
    assert not np.isnan(np.asarray(found.transition.next_state.points)).any()


def test_shapes_do_not_depend_on_how_long_a_trial_was():
    config = LabelConfig(start_every=2, horizon=3)
    sizes = set()
    for steps in (1, 4, 10):
        (trajectory,) = executed([record(steps)])
        found, keep = judged_by_outcome(Towed(), trajectory, ERROR, config, steps=10)
        sizes.add((len(keep), found.transition.action.shape))
        expected = sum(min(3, steps - start) for start in range(0, steps, 2))
        assert keep.sum() == expected and np.asarray(found.right)[keep].all()
    assert len(sizes) == 1


def test_trials_that_did_nothing_or_broke_down_teach_what_they_did():
    assert trajectory_of(record(0)) is None
    broken = record(5)
    points = broken.points.copy()
    points[3:] = np.nan
    rest = trajectory_of(replace(broken, points=points))
    assert rest is not None and rest.actions.shape == (1, 2, 1, 3)
    points[1:] = np.nan
    assert trajectory_of(replace(broken, points=points)) is None


def lesson(records, enrichment="none", settings=SMALL):
    """One iteration of a fresh learner."""
    one = learner(enrichment, settings=settings)
    taken = one.taken(one.fresh(0), records, 0, 1)
    learned = one.learned(taken.known, 0, 1)
    return learned.known, taken.figures | learned.figures, (*taken.told, *learned.told)


@pytest.mark.parametrize(
    ("records", "only", "none", "accepted"),
    [([record(6)], "right", "wrong", True), ([record(1, stops_after=0)], "wrong", "right", False)],
)
@pytest.mark.slow
def test_data_of_one_class_are_told_and_learned(records, only, none, accepted):
    """A classifier that has only seen what goes well accepts the like, and the other way round."""
    known, figures, told = lesson(records)
    assert f"were {only}, none {none}" in told[-1]
    assert figures[f"new_{none}"] == 0 < figures[f"new_{only}"] == figures["examples"]
    (trajectory,) = executed(records)
    found, keep = judged_by_outcome(Towed(), trajectory, ERROR, SMALL.labels, SETTINGS.actions)
    first = int(np.flatnonzero(keep)[0])
    one = jax.tree.map(lambda leaf: leaf[first], found)
    judged = member(known.models, 0)(one.obstacles, one.transition)
    assert bool(judged.accepted) == accepted


@pytest.mark.slow
def test_examples_that_are_made_keep_labels_and_what_touches_what():
    """Augmentations neither enter the wall nor leave it; half are made of what was wrong."""
    records = [record(8, stops_after=4)]
    known, figures, told = lesson(records, "augmentation")
    assert told == () and 0 < figures["new_made"] <= SMALL.attempts
    items, weight = known.buffer.items, np.asarray(known.buffer.weight) > 0
    count = int(figures["new_right"] + figures["new_wrong"])
    assert weight.sum() == count + figures["new_made"] == figures["examples"]
    made = jax.tree.map(lambda leaf: leaf[count : int(weight.sum())], items)
    assert 0.1 < 1 - np.asarray(made.right).mean() < 0.9
    own = jax.tree.map(lambda leaf: leaf[:count], items)

    def nearest(some):
        states = some.transition.state
        return np.asarray(jax.vmap(signed_distance)(some.obstacles, states.points)).min(1)

    assert nearest(own).min() > 0.1 and nearest(made).min() > 0.01  # the rope's radius: nothing is touched
    for wrong in (True, False):
        lengths = np.linalg.norm(np.asarray(made.transition.action)[np.asarray(made.right) != wrong], axis=-1)
        assert lengths == pytest.approx(STEP, abs=1e-5)


def test_where_nothing_made_is_valid_that_is_told(monkeypatch):
    def none_valid(kind, key, labelled, keep, setting, config, attempts):
        blank = jax.tree.map(lambda leaf: jnp.zeros((attempts, *leaf.shape[1:]), leaf.dtype), labelled)
        return blank, np.zeros(attempts, dtype=bool)

    monkeypatch.setattr("doojax.experiments.online.reliability.enriched", none_valid)
    _, figures, told = lesson([record(8, stops_after=4)], "augmentation")
    assert figures["new_made"] == 0 and "no augmentation of" in told[0] and "was valid" in told[0]


def test_noise_keeps_labels_and_moves_every_place_by_half_a_centimetre():
    known, figures, _ = lesson([record(8, stops_after=4)], "noise")
    count = int(figures["new_right"] + figures["new_wrong"])
    made = jax.tree.map(lambda leaf: np.asarray(leaf)[count : count + SMALL.attempts], known.buffer.items)
    off = made.transition.state.points[..., 1]  # the rope lies on the x axis
    assert off.std() == pytest.approx(0.005, rel=0.15)
    assert made.right.any() and not made.right.all()


def test_classes_count_alike_and_one_that_is_alone_counts_all():
    right = jnp.array([True, True, True, False, False])
    weight = jnp.array([1.0, 1.0, 2.0, 1.0, 0.0])
    assert class_weights(weight, right).tolist() == pytest.approx([0.25, 0.25, 0.5, 1.0, 0.0])
    assert class_weights(weight, jnp.ones(5, dtype=bool)).tolist() == pytest.approx([0.2, 0.2, 0.4, 0.2, 0.0])


def test_examples_are_measured_as_often_as_they_weigh():
    assert np.bincount(evenly(jnp.array([1.0, 0.0, 2.0, 1.0]), 8), minlength=4).tolist() == [2, 0, 4, 2]


def test_a_buffer_takes_what_is_to_be_kept_and_no_place_for_the_rest():
    buffer = Buffer.like(jnp.zeros(1), capacity=4)
    buffer = buffer.added(jnp.array([1.0, 2.0, 3.0]), keep=jnp.array([True, False, True]))
    assert buffer.items.tolist() == [1, 3, 0, 0] and buffer.weight.tolist() == [1, 1, 0, 0]
    buffer = buffer.added(jnp.array([4.0, 5.0, 6.0]), keep=jnp.array([True, True, True]))
    assert buffer.items.tolist() == [6, 3, 4, 5] and int(buffer.count) == 5
    same = buffer.added(jnp.array([7.0]), keep=jnp.array([False]))
    assert same.items.tolist() == buffer.items.tolist() and int(same.count) == 5


def test_settings_that_learn_nothing_are_refused():
    with pytest.raises(ValueError, match="attempts is 0, expected at least 1"):
        ReliabilitySettings(attempts=0)
    assert SIMULATOR.scene is TOY.scene
