"""Networks of pouring: what changes nothing, what their files hold, what a judge sees."""

from dataclasses import asdict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.keys import stream
from doojax.learning.checkpoints import Header, load_model, save_model
from doojax.models.builders import dynamics_network
from doojax.models.deviation import DeviationEstimator
from doojax.models.ensemble import Ensemble
from doojax.models.pouring import PouringConfig, PouringDynamics, PouringJudgeConfig, sent_to
from doojax.types import Obstacles, PouringState, ShapeKind, Transition
from tests.calls import called

SMALL = PouringConfig(width=8, depth=1)


def state_at(x, z, angle=0.0, volumes=(0.0, 1.0), receiver=(0.5, 0.0, 0.02)):
    size = jnp.array([0.14, 0.13])
    place = jnp.array([x, 0.0, z])
    return PouringState(place, jnp.array(angle), jnp.array(receiver), jnp.array(volumes), size)


@pytest.fixture(scope="module")
def network():
    return dynamics_network(SMALL, key=stream(0, "test"))


def test_moving_everything_moves_what_is_predicted(network):
    assert isinstance(network, PouringDynamics)
    action = jnp.array([[0.1, -0.05, 0.3]])
    here, _ = called(network, None, state_at(0.2, 0.3), action)
    there, _ = called(network, None, state_at(0.9, 0.4, receiver=(1.2, 0.0, 0.12)), action)
    np.testing.assert_allclose(there.container - here.container, [0.7, 0.0, 0.1], atol=1e-5)
    np.testing.assert_allclose(there.volumes, here.volumes, atol=1e-5)
    assert float(there.angle) == pytest.approx(float(here.angle), abs=1e-5)


def test_a_network_that_changes_nothing_gets_where_it_is_sent(network):
    quiet = eqx.tree_at(lambda one: one.output_scale, network, jnp.zeros(5))
    state, action = state_at(0.2, 0.3, volumes=(0.25, 0.5)), jnp.array([[0.1, -0.05, 2.5]])
    after, doubt = called(quiet, None, state, action)
    assert eqx.tree_equal(after, called(sent_to, state, action)) and float(doubt) == 0
    np.testing.assert_allclose(after.container, [0.3, 0.0, 0.25], atol=1e-6)


def test_scales_are_those_of_the_transitions(network):
    states = jax.vmap(lambda x: state_at(0.0, 0.3, volumes=(0.0, 1.0)))(jnp.zeros(4))
    states = eqx.tree_at(lambda s: s.container, states, states.container.at[:, 0].set(jnp.arange(4.0)))
    actions = jnp.zeros((4, 1, 3))
    after = eqx.tree_at(lambda s: s.volumes, states, jnp.array([[0.0, 1.0], [0.5, 0.5]] * 2))
    scaled = called(network.scaled_to, states, actions, after)
    assert float(scaled.input_mean[0]) == pytest.approx(10 * (1.5 - 0.5), rel=1e-4)
    np.testing.assert_allclose(scaled.output_scale[3:], 0.25, rtol=1e-4)


def test_a_model_in_a_file_is_one_of_pouring(network, tmp_path):
    ensemble = Ensemble(jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, network))
    header = Header("dynamics", "watering_2d", {**asdict(SMALL), "members": 1})
    save_model(tmp_path / "model.eqx", header, ensemble)
    loaded, _ = load_model(tmp_path, task="watering_2d", kind="dynamics")
    assert eqx.tree_equal(loaded, ensemble)
    judge = DeviationEstimator(PouringJudgeConfig(8, 1), key=stream(1, "test"))
    save_model(
        tmp_path / "d.eqx", Header("deviation", "watering_2d", asdict(PouringJudgeConfig(8, 1))), judge
    )
    assert eqx.tree_equal(load_model(tmp_path / "d.eqx", kind="deviation")[0], judge)


def test_a_judge_sees_what_is_near_and_not_what_is_far():
    judge = DeviationEstimator(PouringJudgeConfig(16, 2), key=stream(1, "test"))
    state, action = state_at(0.2, 0.3), jnp.array([[0.1, 0.0, 0.0]])
    step = Transition(state, action, sent_to(state, action), jnp.zeros(()))

    def judged(x):
        box = Obstacles(
            kind=jnp.array([int(ShapeKind.BOX)]),
            centre=jnp.array([[x, 0.0, 0.3]]),
            quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
            half_size=jnp.full((1, 3), 0.05),
            active=jnp.ones(1, bool),
        )
        return float(called(judge, box, step).score)

    assert judged(2.0) == pytest.approx(judged(3.0), rel=1e-5)
    assert abs(judged(0.45) - judged(2.0)) > 1e-6
