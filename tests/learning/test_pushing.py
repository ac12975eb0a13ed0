"""Windows, losses and figures of pushed bodies, worked by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.keys import stream
from doojax.learning.pushing import PropNetProblem, PushingData, measured, position_errors, stay_error
from doojax.models.propnet import PropNet, PropNetConfig
from doojax.types import PushingState

CONFIG = PropNetConfig(2, 0.25, particle=4, relation=4, effect=4, passes=1)
STEP = 0.004


def data(count: int = 3, states: int = 5) -> PushingData:
    """Body 0 goes along x by 4 mm each period; body 1 and the hand, far from it, rest."""
    x = np.zeros((count, states, 2, 3))
    x[..., 0, 0] = STEP * np.arange(states)
    x[..., 1, 1] = 0.3
    hand = np.broadcast_to([0.0, -0.3, 0.0], (count, states, 3))
    return PushingData.of(
        PushingState(
            jnp.asarray(x, jnp.float32), jnp.zeros((count, states, 2, 3)), jnp.asarray(hand, jnp.float32)
        )
    )


def still() -> PropNet:
    """A network that predicts that nothing moves."""
    model = PropNet(CONFIG, key=stream(0, "test"))
    return jax.tree.map(lambda leaf: 0 * leaf if isinstance(leaf, jax.Array) else leaf, model)


def test_moves_are_differences_and_the_hand_is_last():
    one = data()
    np.testing.assert_allclose(one.moves[0, :, 0], [[STEP, 0.0]] * 4, atol=1e-7)
    np.testing.assert_allclose(one.places[0, 0], [[0, 0], [0, 0.3], [0, -0.3]], atol=1e-7)


def test_the_loss_of_standing_still_is_the_mean_motion():
    problem = PropNetProblem(data(), data(), CONFIG, window=2, steps=3)
    loss = problem.loss(still(), jnp.array([0, 4]), None)
    assert float(loss) == pytest.approx(STEP / 2, rel=1e-3)  # one of two bodies moves


def test_members_see_windows_of_their_own_trajectories_only():
    problem = PropNetProblem(data(6), data(), CONFIG, window=2, steps=50)
    rows = problem.batches((jnp.array(2), jnp.array(3)), 8, key=stream(0, "test"))
    trajectory, start = np.divmod(np.asarray(rows), problem.starts)
    assert rows.shape == (50, 8) and set(trajectory.ravel()) == {2, 3, 4} and set(start.ravel()) == {0, 1, 2}


def test_figures_of_standing_still():
    """Body 0 is left behind by 4, 8, 12 and 16 mm: 5 mm in the mean over two bodies."""
    given = data()
    errors = position_errors(still(), given)
    np.testing.assert_allclose(errors[0], [[STEP * k, 0.0] for k in range(1, 5)], atol=1e-6)
    figures = measured(still(), given)
    assert float(figures["position_error"]) == pytest.approx(0.005, abs=1e-6)
    assert stay_error(given) == pytest.approx(0.005, abs=1e-6)
    assert float(figures["penetration"]) == 0.0 and float(figures["ghostly"]) == 0.0


def test_bodies_that_lie_in_each_other_and_move_by_themselves_are_told():
    given = data()
    close = PushingData(given.places.at[:, :, 1, 1].set(0.03), given.moves)
    assert float(measured(still(), close)["penetration"]) > 0.005
    drifting = eqx.tree_at(lambda m: m.predictor.layers[-1].bias, still(), jnp.array([0.001, 0.0]))
    assert float(measured(drifting, given)["ghostly"]) == pytest.approx(0.001, rel=1e-3)
