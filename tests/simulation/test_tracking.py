"""A stand-in for a real robot: how far off it is, what it sees, and that the truth goes on beneath."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.simulation.tracking import EXACT, Tracked, Tracking, followed, hidden
from doojax.tasks import make_task
from doojax.tasks.base import observed
from doojax.types import Obstacles, ShapeKind

COUNT, PERIODS = 16, 24


@pytest.fixture(scope="module")
def simulator():
    return make_task("rope_dragging").simulator("mujoco")


@pytest.fixture(scope="module")
def starts(simulator):
    return jax.jit(jax.vmap(simulator.reset))(jax.random.split(jax.random.key(1), COUNT))


def begun(simulator, starts, tracking):
    tracked = Tracked(simulator, tracking)
    return tracked, tracked.begun(starts, jax.random.split(jax.random.key(2), len(starts.qpos)))


def still(count, periods):
    return jnp.zeros((count, periods, 1, 3))


@pytest.mark.slow
def test_without_errors_it_is_the_simulator(simulator, starts):
    tracked, states = begun(simulator, starts, EXACT)
    actions = 0.05 * jax.random.normal(jax.random.key(3), (COUNT, 3, 1, 3)).at[..., 2].set(0)
    _, known = tracked.rollout(states, actions)
    _, true = simulator.rollout(starts, actions)
    for a, b in zip(jax.tree.leaves(known), jax.tree.leaves(true), strict=True):
        assert jnp.array_equal(a, b)


@pytest.mark.slow
def test_hands_are_as_far_off_as_was_said_however_long_they_move(simulator, starts):
    tracked, states = begun(simulator, starts, Tracking(hand_error=0.03, correlation=0.6))
    errors = [states.astray]
    for _ in range(PERIODS):
        states, known = tracked.rollout(states, still(COUNT, 1))
        errors.append(states.astray)
        # what is known of a hand that stays is where it was sent; where it is, is where the error has it
        off = tracked.truth(states).grippers - known.states.grippers[:, -1]
        assert jnp.allclose(off, states.astray, atol=1e-6)
    errors = np.stack(errors)[:, :, 0]  # [T, B, 3]
    assert np.sqrt((errors**2).sum(-1).mean()) == pytest.approx(0.03, rel=0.1)
    late, early = (np.sqrt((part**2).sum(-1).mean()) for part in (errors[-10:], errors[:10]))
    assert late == pytest.approx(early, rel=0.4)
    together = (errors[1:] * errors[:-1]).mean() / (errors**2).mean()
    assert together == pytest.approx(0.6, abs=0.1)


def test_the_simulation_goes_on_from_the_truth(simulator, starts):
    tracked, states = begun(simulator, starts, Tracking(hand_error=0.02, point_error=0.01))
    after, known = tracked.rollout(states, still(COUNT, 1))
    executed = (after.astray - states.astray)[:, None]
    last, _ = simulator.rollout(starts, executed)
    assert jnp.array_equal(after.qpos, last.qpos)
    assert jnp.array_equal(tracked.truth(after).points, observed(simulator, last).points)
    off = np.asarray(known.states.points[:, -1] - tracked.truth(after).points)
    assert np.sqrt((off**2).sum(-1).mean()) == pytest.approx(0.01, rel=0.2)
    assert jnp.array_equal(observed(tracked, after).points, known.states.points[:, -1])
    assert jnp.array_equal(known.actions, still(COUNT, 1))


@pytest.mark.slow
def test_periods_one_by_one_or_together_are_the_same(simulator, starts):
    tracked, states = begun(simulator, starts, Tracking(0.02, 0.01, camera=(0.0, -2.0, 1.0)))
    one = states
    for _ in range(3):
        one, _ = tracked.rollout(one, still(COUNT, 1))
    together, known = tracked.rollout(states, still(COUNT, 3))
    assert jnp.allclose(one.estimate, together.estimate, atol=1e-6)
    assert jnp.allclose(one.qpos, together.qpos, atol=1e-6)
    assert known.states.points.shape[1] == 4


def test_what_a_box_stands_before_is_hidden():
    # the camera looks along x at points on the y axis; a box of 20 cm half-way hides those within 20 cm
    box = Obstacles(
        kind=jnp.array([int(ShapeKind.BOX)]),
        centre=jnp.array([[1.0, 0.0, 0.0]]),
        quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
        half_size=jnp.array([[0.01, 0.1, 0.1]]),
        active=jnp.array([True]),
    )
    y = jnp.array([-0.3, -0.21, -0.19, 0.0, 0.19, 0.21, 0.3])
    points = jnp.stack([jnp.zeros(7), y, jnp.zeros(7)], axis=1)
    found = hidden((2.0, 0.0, 0.0), box, points, 0.001)
    assert found.tolist() == [False, False, True, True, True, False, False]
    # a rope that lies on the side that is seen is seen, though it touches
    touching = jnp.array([[1.01, 0.0, 0.0]])
    assert not hidden((2.0, 0.0, 0.0), box, touching, 0.005)[0]


def test_hidden_points_move_as_those_beside_them():
    before = jnp.zeros((5, 3))
    now = jnp.zeros((5, 3)).at[:, 0].set(jnp.array([0.1, 9.0, 9.0, 0.4, 9.0]))
    unseen = jnp.array([False, True, True, False, True])
    found = followed(before, now, unseen)
    # between 0.1 and 0.4 in thirds; beyond the last that is seen, as that one
    assert jnp.allclose(found[:, 0], jnp.array([0.1, 0.2, 0.3, 0.4, 0.4]), atol=1e-6)
    assert jnp.array_equal(followed(before, now, jnp.ones(5, bool)), before)
    assert jnp.array_equal(followed(before, now, jnp.zeros(5, bool)), now)


def test_only_ropes_are_tracked_and_errors_are_lengths():
    with pytest.raises(ValueError, match="only a rope can be tracked"):
        Tracked(make_task("planar_pushing").simulator("mujoco"), EXACT)
    with pytest.raises(ValueError, match=r"hand_error is -0.1, expected 0 to 1 m"):
        Tracking(hand_error=-0.1)
    with pytest.raises(ValueError, match=r"correlation is 1.0, expected 0 or more and less than 1"):
        Tracking(correlation=1.0)
