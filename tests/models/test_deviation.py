"""The estimator of deviations as a judge, and as a file."""

from dataclasses import asdict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.learning.checkpoints import Header, load_model, save_model
from doojax.models import Reliability
from doojax.models.classifier import ClassifierConfig
from doojax.models.deviation import DeviationEstimator
from doojax.types import Obstacles, RopeState, Transition
from tests.calls import called

CONFIG = ClassifierConfig(grippers=2, origin="centroid", width=4, layers=1, midpoints=False)
OBSTACLES = Obstacles(
    kind=jnp.zeros(1, jnp.int32),
    centre=jnp.array([[0.9, 0.1, 0.85]]),
    quaternion=jnp.array([[1.0, 0, 0, 0]]),
    half_size=jnp.full((1, 3), 0.05),
    active=jnp.ones(1, dtype=bool),
)
ROPE = jnp.stack([jnp.linspace(0.7, 1.0, 5), jnp.zeros(5), jnp.full(5, 0.8)], axis=-1)
STEP = Transition(
    RopeState(ROPE, ROPE[jnp.array([0, -1])]),
    jnp.full((2, 3), 0.02),
    RopeState(ROPE + 0.02, ROPE[jnp.array([0, -1])] + 0.02),
    jnp.array(0.01),
)


@pytest.fixture(scope="session")
def model():
    made = DeviationEstimator(CONFIG, key=jax.random.key(0))
    return eqx.tree_at(lambda one: one.scale, made, jnp.asarray(0.02))


def test_a_transition_is_accepted_where_its_bound_is_below_the_limit(model):
    deviation = float(called(model.deviation, OBSTACLES, STEP))
    assert isinstance(model, Reliability)
    assert deviation == pytest.approx(float(called(model.uncalibrated, OBSTACLES, STEP)) + 1e-6, rel=1e-4)
    for limit, factor, accepted in ((1.1, 1.0, True), (0.9, 1.0, False), (1.1, 2.0, False), (2.1, 2.0, True)):
        found = called(model.limited(limit * deviation).bounded(factor), OBSTACLES, STEP)
        assert bool(found.accepted) == accepted
        assert bool(found.possible)  # what is learned forbids nothing for good
        assert float(found.score) == pytest.approx(factor * deviation, rel=1e-5)
    assert not bool(called(model.limited(1e3).bounded(np.inf), OBSTACLES, STEP).accepted)


def test_a_calibrated_deviation_is_a_power_of_the_networks_own(model):
    changed = eqx.tree_at(lambda one: (one.power, one.shift), model, (jnp.asarray(1.5), jnp.log(2.0)))
    raw = float(called(model.uncalibrated, OBSTACLES, STEP))
    assert float(called(changed.deviation, OBSTACLES, STEP)) == pytest.approx(2 * raw**1.5, rel=1e-3)


def test_training_moves_the_network_alone(model):
    gradient = eqx.filter_jit(eqx.filter_grad(lambda one: one.uncalibrated(OBSTACLES, STEP)))(model)
    for name in ("scale", "power", "shift", "limit", "factor"):
        assert float(getattr(gradient, name)) == 0.0
    assert float(jnp.abs(gradient.network.embed.weight).max()) > 0


def test_it_survives_a_file(model, tmp_path):
    kept = model.limited(0.03).bounded(1.7)
    header = Header("deviation", "dual_gripper", asdict(CONFIG), {"conformal_factors": {"0.1": 1.7}})
    save_model(tmp_path / "model.eqx", header, kept)
    loaded, found = load_model(tmp_path, kind="deviation", task="dual_gripper")
    assert found == header
    assert called(loaded, OBSTACLES, STEP).score == called(kept, OBSTACLES, STEP).score
    assert float(loaded.limit) == pytest.approx(0.03)
