"""Labels of hand-made trajectories under a model whose errors are known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.learning.data import Trajectories
from doojax.learning.labels import (
    THESIS,
    LabelConfig,
    error_threshold,
    label,
    rms_distance,
)
from doojax.models.dynamics import DynamicsConfig, UnconstrainedDynamics
from doojax.models.ensemble import Ensemble
from doojax.types import Obstacles, RopeState

POINTS = 2


@pytest.fixture(scope="session")
def still():
    """Two networks without weights: grippers go where they are sent, points stay where they are."""
    config = DynamicsConfig(points=POINTS, grippers=1, origin="gripper", width=4)
    keys = jax.random.split(jax.random.key(0), 2)
    members = eqx.filter_vmap(lambda key: UnconstrainedDynamics(config, key=key))(keys)
    nothing = jax.tree.map(lambda x: x * 0 if eqx.is_inexact_array(x) else x, members.network)
    return Ensemble(eqx.tree_at(lambda m: m.network, members, nothing))


def trajectories(*positions):
    """K ropes of two points that lie side by side at x = positions[k][t] (m)."""
    x = np.array(positions, np.float32)
    points = np.zeros((*x.shape, POINTS, 3), np.float32)
    points[..., 0] = x[..., None]
    points[..., 1, 1] = 0.1
    count, length = x.shape
    scene = Obstacles(
        kind=jnp.zeros((count, 1), jnp.int32),
        centre=jnp.zeros((count, 1, 3)),
        quaternion=jnp.ones((count, 1, 4)),
        half_size=jnp.ones((count, 1, 3)),
        active=jnp.zeros((count, 1), bool),
    )
    return Trajectories(
        states=RopeState(jnp.asarray(points), jnp.zeros((count, length, 1, 3))),
        actions=jnp.zeros((count, length - 1, 1, 3)),
        obstacles=scene,
        rows=jnp.arange(count),
    )


def test_distances_of_ropes_by_hand():
    left = RopeState(jnp.zeros((4, 3)), jnp.zeros((1, 3)))
    right = RopeState(jnp.zeros((4, 3)).at[0].set(jnp.array([0.0, 0.3, 0.4])), jnp.ones((1, 3)))
    assert float(rms_distance(left, right)) == pytest.approx(0.25)  # sqrt(0.5^2 / 4); no grippers


def test_from_every_state_for_two_steps(still):
    # x goes 0, 1, 1, 1 cm: predictions that begin at the first state are 1 cm off, the others are right
    data = trajectories([0.0, 0.01, 0.01, 0.01])
    found = label(still, data, LabelConfig(start_every=1, horizon=2))
    np.testing.assert_allclose(found.error, [0.01, 0.01, 0, 0, 0], atol=1e-7)  # starts 0, 0, 1, 1, 2
    np.testing.assert_allclose(found.error_before, [0, 0.01, 0, 0, 0], atol=1e-7)
    assert np.asarray(found.kept(0.005)).tolist() == [True, False, True, True, True]
    assert np.asarray(found.right(0.005)).tolist() == [False, False, True, True, True]


@pytest.mark.parametrize("rollout", ["mean", "members"])
def test_the_last_transition_of_a_window_that_runs_past_the_end(still, rollout):
    """The last action moves the rope by 5 cm; whoever predicts that it stands still is 5 cm off there."""
    data = trajectories([0.0, 0.0, 0.0, 0.05])
    found = label(still, data, LabelConfig(start_every=1, horizon=2, rollout=rollout))
    # starts 0, 0, 1, 1, 2: the second of start 1 and the only one of start 2 end where the trajectory ends
    np.testing.assert_allclose(found.error, [0, 0, 0, 0.05, 0.05], atol=1e-7)
    np.testing.assert_allclose(found.error_before, 0, atol=1e-7)


@pytest.mark.parametrize(
    ("start_every", "horizon", "discard"),
    [(1, 2, "after first"), (2, 4, "while far"), (3, 7, "after first"), (5, 10, "while far")],
)
def test_labels_beside_a_plain_loop(still, start_every, horizon, discard):
    """No two states of these ropes are at one place, so that an index that is off by one shows."""
    x = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.05, (2, 8)), axis=1)
    expected = []
    for row in x:
        for start in range(0, 7, start_every):
            errors = [abs(row[min(start + step, 7)] - row[start]) for step in range(horizon + 1)]
            for step in range(min(horizon, 7 - start)):
                before = max(errors[: step + 1]) if discard == "after first" else errors[step]
                expected.append((before, errors[step + 1]))
    config = LabelConfig(start_every=start_every, horizon=horizon, discard=discard)
    found = label(still, trajectories(*x), config)
    np.testing.assert_allclose(np.stack([found.error_before, found.error], 1), expected, atol=1e-6)


def test_states_that_a_transition_begins_with_are_predicted_ones(still):
    data = trajectories([0.0, 0.01, 0.02])
    found = label(still, data, LabelConfig(start_every=1, horizon=2))
    np.testing.assert_allclose(found.transition.state.points[:, 0, 0], [0, 0, 0.01], atol=1e-7)
    np.testing.assert_allclose(found.transition.uncertainty, 0)


@pytest.mark.parametrize(
    ("discard", "kept"), [("after first", [True, False, False]), ("while far", [True, False, True])]
)
def test_predictions_that_come_back_into_line(still, discard, kept):
    # once wrong, the text of the thesis drops all the rest; the code keeps what is right again
    data = trajectories([0.0, 0.01, 0.0, 0.0])
    found = label(still, data, LabelConfig(start_every=3, horizon=3, discard=discard))
    np.testing.assert_allclose(found.error, [0.01, 0, 0], atol=1e-7)
    assert np.asarray(found.kept(0.005)).tolist() == kept


def test_the_thesis_predicts_once_from_each_trajectorys_first_state(still):
    data = trajectories([0.0, 0.01, 0.02, 0.03], [0.0, 0.0, 0.0, 0.0])
    found = label(still, data, THESIS)
    np.testing.assert_allclose(found.error, [0.01, 0.02, 0.03, 0, 0, 0], atol=1e-7)
    assert np.asarray(found.trajectory).tolist() == [0, 0, 0, 1, 1, 1]


def test_the_threshold_is_a_quantile_over_steps_and_members_without_the_first_state(still):
    # errors 1, 2, 3 and 0, 0, 0 cm, twice: two members that agree; with first states it would be lower
    data = trajectories([0.0, 0.01, 0.02, 0.03], [0.0, 0.0, 0.0, 0.0])
    expected = np.quantile(2 * [0.01, 0.02, 0.03, 0, 0, 0], 0.9)
    assert error_threshold(still, data) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", ["start_every", "horizon"])
def test_labels_that_no_prediction_would_have(name):
    with pytest.raises(ValueError, match=f"{name} is 0, expected at least 1"):
        LabelConfig(**{name: 0})
