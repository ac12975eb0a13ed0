"""Ensembles by hand: their mean, their spread, and how members roll out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.models.dynamics import DynamicsConfig, UnconstrainedDynamics
from doojax.models.ensemble import Ensemble, summary
from doojax.models.rolling import roll_out
from doojax.types import RopeState
from tests.calls import called

from .voxel_examples import box


@pytest.fixture(scope="module")
def ensemble() -> Ensemble:
    """Three members of one point and one gripper with random weights."""
    config = DynamicsConfig(points=1, grippers=1, origin="gripper", width=8)
    keys = jax.random.split(jax.random.key(0), 3)
    return Ensemble(eqx.filter_vmap(lambda key: UnconstrainedDynamics(config, key=key))(keys))


START = RopeState(jnp.array([[0.3, 0.1, 0.0]]), jnp.array([[0.4, 0.1, 0.0]]))
ACTIONS = 0.1 * jax.random.normal(jax.random.key(1), (4, 1, 3))


def alone(ensemble, index):
    return jax.tree.map(lambda leaf: leaf[index] if eqx.is_array(leaf) else leaf, ensemble.members)


def test_the_spread_by_hand():
    # x = 0, 0.3, 0.6 m: deviations of the population -0.3, 0, 0.3, so sqrt(0.06) = 0.2449; y = 1, 1, 1;
    # the gripper's z = 0, 0, 0.3: mean 0.1, sqrt((0.01 + 0.01 + 0.04) / 3) = 0.1414
    points = jnp.zeros((3, 1, 3)).at[:, 0, 0].set(jnp.array([0.0, 0.3, 0.6])).at[:, 0, 1].set(1.0)
    grippers = jnp.zeros((3, 1, 3)).at[2, 0, 2].set(0.3)
    mean, spread = summary(RopeState(points, grippers))
    np.testing.assert_allclose(mean.points, [[0.3, 1.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(mean.grippers, [[0, 0, 0.1]], atol=1e-6)
    assert float(spread) == pytest.approx(0.06**0.5 + 0.02**0.5, abs=1e-6)


def test_members_that_agree_have_no_spread(ensemble):
    same = Ensemble(jax.tree.map(lambda x: x[:1].repeat(3, 0) if eqx.is_array(x) else x, ensemble.members))
    after, spread = called(same, None, START, ACTIONS[0])
    assert float(spread) == pytest.approx(0, abs=1e-6)
    expected = called(alone(ensemble, 0).predict, START, ACTIONS[0])
    np.testing.assert_allclose(after.points, expected.points, atol=1e-6)
    assert float(called(ensemble, None, START, ACTIONS[0])[1]) > 0.01


def test_members_roll_out_on_their_own(ensemble):
    """Beside a plain loop; from the mean, as planners go on, it comes out differently."""
    means, spread = called(ensemble.roll_out_members, None, START, ACTIONS)
    states = [START] * ensemble.size
    for step, action in enumerate(ACTIONS):
        states = [called(alone(ensemble, i).predict, state, action) for i, state in enumerate(states)]
        points, grippers = (
            np.stack([np.asarray(getattr(state, name)) for state in states])
            for name in ("points", "grippers")
        )
        np.testing.assert_allclose(means.points[step + 1], points.mean(0), atol=1e-5)
        expected = points.std(0).sum() + grippers.std(0).sum()
        assert float(spread[step]) == pytest.approx(expected, abs=1e-5)
    together, doubt = called(roll_out, ensemble, None, START, ACTIONS)
    np.testing.assert_allclose(means.points[1], together.points[1], atol=1e-6)
    assert float(spread[0]) == pytest.approx(float(doubt[0]), abs=1e-6)
    assert float(jnp.abs(means.points[-1] - together.points[-1]).max()) > 1e-4
    assert float(spread[-1]) > 1.2 * float(doubt[-1])  # what members disagree about adds up


def test_a_roll_out_repeats_one_step(ensemble):
    states, doubt = called(roll_out, ensemble, None, START, ACTIONS)
    np.testing.assert_array_equal(states.points[0], START.points)
    state = START
    for step, action in enumerate(ACTIONS):
        state, uncertainty = called(ensemble, None, state, action)
        np.testing.assert_allclose(states.points[step + 1], state.points, atol=1e-5)
        assert float(doubt[step]) == pytest.approx(float(uncertainty), abs=1e-5)


class Pushed(eqx.Module):
    """Dynamics that look at the obstacles: the rope goes towards the first one's middle, at its own speed."""

    speed: jax.Array

    def __call__(self, obstacles, state, action):
        change = self.speed * (obstacles.centre[0] - state.points[0])
        return jax.tree.map(lambda leaf: leaf + change[None], state), jnp.array(9.0)


def test_any_dynamics_make_an_ensemble_also_those_that_look_at_obstacles():
    both = Ensemble(Pushed(jnp.array([0.1, 0.3])))
    wall = box(1.3, 0.1, 0.0)  # 1 m along x from the rope's point
    after, spread = both(wall, START, ACTIONS[0])
    assert both.size == 2
    np.testing.assert_allclose(after.points - START.points, [[0.2, 0, 0]], atol=1e-6)
    assert float(spread) == pytest.approx(2 * 0.1)  # the point's and the gripper's x, each 0.1 and 0.3
