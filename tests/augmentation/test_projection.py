"""The projection on a rope that lies on a slab beside a post: where it ends is known."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.augmentation.objectives import Weights
from doojax.augmentation.projection import ProjectionConfig, objective, project
from doojax.types import Verdict

from .problems import lying_rope

HALF_RANGE = np.array([0.25, 0.25, 0.25, 0.0, 0.0, 0.5])
BATCH = 8
ONE_ROUND = ProjectionConfig(rounds=1)


@eqx.filter_jit
def batch(targets, usable, config):
    problem = lying_rope()
    found = jax.vmap(lambda target, use: project(problem, target, use, config))(targets, usable)
    evaluate = objective(problem, config)

    def total(parameters):
        return evaluate(parameters)[0].total(Weights())

    return found, jax.vmap(total)(targets), jax.vmap(lambda at: evaluate(at)[1])(found.parameters)


def projected(*targets, config=ProjectionConfig()):  # noqa: B008
    """Padded to one batch size, so that one program serves all tests."""
    rows = np.resize(np.array(targets, np.float32), (BATCH, 6))
    found, began, fails = batch(jnp.array(rows), jnp.ones(BATCH, bool), config)
    return jax.tree.map(lambda leaf: np.array(leaf)[: len(targets)], (found, began, fails))


def test_along_the_slab_it_reaches_its_target():
    target = [-0.2, 0.1, 0.0, 0.0, 0.0, 0.4]
    found, _, _ = projected(target)
    assert found.verdict[0] == Verdict.ACCEPTED
    np.testing.assert_allclose(found.parameters[0], target, atol=1e-6)


def test_from_the_slab_it_is_brought_back_down_or_up():
    found, _, fails = projected([-0.2, 0.1, -0.1, 0.0, 0.0, 0.0], [-0.2, 0.1, 0.1, 0.0, 0.0, 0.0])
    assert (found.verdict == Verdict.ACCEPTED).all() and not fails.any()
    np.testing.assert_allclose(found.parameters[:, :2], [[-0.2, 0.1]] * 2, atol=2e-3)
    np.testing.assert_allclose(found.parameters[:, 2], 0.0, atol=2e-3)


def test_the_post_is_in_the_way():
    """0.24 m along x the rope, 1 cm thick, would be in a post whose side is at 0.25 m."""
    found, _, fails = projected([0.249, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert found.verdict[0] == Verdict.ACCEPTED and not fails.any()
    assert found.parameters[0, 0] <= 0.25 - 0.01 - 0.0009


@pytest.mark.slow
def test_what_the_descent_does_not_look_at_is_checked_at_the_end():
    """Of the rope only one end, away from the post: of five rounds along x the last one ends in the post."""
    problem = replace(lying_rope(), some=jnp.array([0]))
    target = jnp.array([0.249, 0.0, 0.0, 0.0, 0.0, 0.0])
    found = jax.jit(lambda target: project(problem, target, jnp.array(True)))(target)
    assert found.verdict == Verdict.ACCEPTED
    assert found.parameters[0] == pytest.approx(0.8 * 0.249, abs=1e-6)
    assert not objective(problem, ProjectionConfig())(found.parameters)[1].any()
    alone = jax.jit(lambda target: project(problem, target, jnp.array(True), ONE_ROUND))(target)
    assert alone.verdict == Verdict.OCCUPANCY


def test_nothing_to_do_is_no_progress():
    found, _, _ = projected(np.zeros(6))
    assert found.verdict[0] == Verdict.NO_PROGRESS
    np.testing.assert_array_equal(found.parameters[0], np.zeros(6))


targets = st.tuples(*(st.floats(-bound, bound, width=32) for bound in HALF_RANGE.astype(np.float32).tolist()))


@settings(max_examples=30, deadline=None)
@given(target=targets, others=st.lists(targets, min_size=BATCH - 1, max_size=BATCH - 1))
def test_a_round_never_ends_higher_and_no_element_knows_the_others(target, others):
    found, began, _ = projected(target, *others, config=ONE_ROUND)
    assert (found.objective <= began + 1e-7).all()
    assert (np.abs(found.parameters) <= HALF_RANGE.astype(np.float32)).all()
    alone, _, _ = projected(target, config=ONE_ROUND)
    for name in ("parameters", "verdict", "iterations"):
        np.testing.assert_array_equal(getattr(alone, name)[0], getattr(found, name)[0])


@settings(max_examples=20, deadline=None)
@given(several=st.lists(targets, min_size=BATCH, max_size=BATCH))
def test_what_is_accepted_keeps_every_check(several):
    found, _, fails = projected(*several)
    accepted = found.verdict == Verdict.ACCEPTED
    assert not fails[accepted].any()
    assert set(found.verdict) <= {Verdict.ACCEPTED, Verdict.NO_PROGRESS, Verdict.BOX, Verdict.OCCUPANCY}


def test_reasons():
    """Each check fails by itself, with steps too short to mend anything."""
    config = ProjectionConfig(rounds=1, steps=2, longest_step=1e-4)

    @eqx.filter_jit
    def verdict(problem, target, validity, robot):
        terms = {"validity": lambda _: validity, "robot": lambda _: robot}
        return project(problem, target, jnp.array(True), config, **terms).verdict

    def reason(target, validity=0.0, robot=0.0, problem=None):
        given = (jnp.array(target, jnp.float32), jnp.array(validity), jnp.array(robot))
        return Verdict(int(verdict(lying_rope() if problem is None else problem, *given)))

    along = [-0.2, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert reason(along) == Verdict.ACCEPTED
    assert reason(along, validity=1.0) == Verdict.INVALID
    assert reason(along, robot=1.0) == Verdict.ROBOT
    assert reason([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]) == Verdict.OCCUPANCY
    narrow = replace(lying_rope(), box_low=jnp.array([-0.1, -0.3, 0.0]))
    assert reason(along, problem=narrow) == Verdict.BOX
    # a rope 4 cm from the post, which ends 20 cm away from it and as high above the slab
    beside = lying_rope(height=0.2)
    beside = replace(beside, points=beside.points + jnp.array([0.2, 0.0, -0.05]))
    assert reason(along, problem=beside) == Verdict.DISTANCE
    assert reason([0.005, 0.0, 0.0, 0.0, 0.0, 0.0], problem=narrow) == Verdict.NO_PROGRESS


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rounds": 0}, "rounds is 0, expected at least 1"),
        ({"skin": 0.0}, "skin is 0.0, expected more than 0 m"),
        ({"least_motion": float("nan")}, "least_motion is nan"),
        ({"least_progress": -1.0}, "least_progress is -1.0"),
    ],
)
def test_configs_that_make_no_sense(given, message):
    with pytest.raises(ValueError, match=message):
        ProjectionConfig(**given)
