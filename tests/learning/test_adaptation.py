"""Adapting to what is alike: a target of which half moves as the source does, nearly, and half is stuck."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.learning.adaptation import (
    BINS,
    AdaptationConfig,
    AdaptationProblem,
    Weighed,
    adapt,
    similarity_threshold,
    similarity_weights,
)
from doojax.learning.buffer import Buffer
from doojax.learning.fit import FitConfig, Progress
from doojax.learning.pieces import cut
from doojax.models.ensemble import Ensemble
from tests.learning.slopes import FREE, STUCK, Slope, moves, source

GAMMA = 0.15  # m; moves are up to 1 m, of which the source's model is off by a fifth, or wholly
TRAINING = FitConfig(epochs=10, batch_size=16, learning_rate=0.02, keep="last")
CONFIG = AdaptationConfig(horizon=1, growth=1e-2, fit=TRAINING)


def adapted(data=None, gamma=GAMMA, dynamics=None, **changes):
    config = replace(CONFIG, **changes)
    return adapt(dynamics or source(), moves(64) if data is None else data, gamma, config, seed=0)


@settings(max_examples=50, deadline=None)
@given(st.floats(0, 1), st.floats(1e-3, 1), st.floats(0, 100))
def test_weights_are_those_of_the_formula(error, gamma, sharpness):
    weight = float(similarity_weights(jnp.asarray(error), gamma, sharpness))
    assert weight == pytest.approx(1 - 1 / (1 + np.exp(-sharpness * (error - gamma))), abs=1e-5)


def test_weights_worked_out_by_hand():
    # facts of the released code, for 75 numbers: gamma .08, phi .5 j; at j = 75 0.04 -> .82, .12 -> .18
    found = similarity_weights(jnp.array([0.04, 0.12]) / 5, 0.08 / 5, 0.5 * 75 * 5)
    np.testing.assert_allclose(found, [0.82, 0.18], atol=0.005)
    np.testing.assert_allclose(similarity_weights(jnp.array([0.0, 1.0]), 0.1, 0.0), 0.5)
    assert similarity_weights(jnp.array([jnp.nan, jnp.inf]), 0.1, 3.0).tolist() == [0.0, 0.0]


def test_no_gradient_goes_through_the_weights():
    slope = jax.grad(lambda error: similarity_weights(error, 0.1, 50.0))(jnp.asarray(0.1))
    assert float(slope) == 0.0


def problem(**changes):
    pieces = cut(moves(8), 1)
    weighed = Weighed(pieces, jnp.full(pieces.there.shape, 0.1))
    config = replace(CONFIG, **changes)
    return AdaptationProblem(
        Buffer.of(weighed), source(), jnp.asarray(GAMMA), jnp.zeros(()), jnp.zeros(()), config, steps=2
    )


def test_the_gradient_is_that_of_a_loss_with_constant_weights():
    """d/dk of the mean of w (k a - f a)^2 / 1 is the mean of 2 w a^2 (k - f): w is not differentiated."""
    ready = problem().after(Progress(jnp.asarray(10), jnp.asarray(3000)))
    rows = jnp.arange(len(ready.train.items.pieces))
    gradient = jax.grad(lambda model: ready.loss(model, rows, None))(source()).slope
    data = moves(8)
    a = np.asarray(data.actions).ravel()
    factor = np.repeat(np.where(np.asarray(data.states.x[:, 0]) < 0, FREE, STUCK), 4)
    sharpness = 1e-2 * 3000 / GAMMA
    weight = 1 / (1 + np.exp(sharpness * (np.abs((1 - factor) * a) - GAMMA)))
    assert float(gradient) == pytest.approx((2 * weight * a**2 * (1 - factor)).mean(), rel=1e-3)


def test_sharpness_counts_transitions_not_steps():
    after = [problem().after(Progress(jnp.asarray(n), jnp.asarray(480))) for n in (10, 30, 480)]
    assert len({float(one.sharpness) for one in after}) == 1
    assert float(after[0].sharpness) == pytest.approx(1e-2 * 480 / GAMMA)
    counting = problem(counted="steps", growth=0.04)
    steps = [counting.after(Progress(jnp.asarray(n), jnp.asarray(480))).sharpness for n in (10, 30)]
    np.testing.assert_allclose(steps, [0.4 / GAMMA, 1.2 / GAMMA], rtol=1e-5)


@pytest.mark.parametrize("batch_size", [8, 32])
def test_whatever_the_batch_size_as_much_was_seen(batch_size):
    found = adapted(fit=replace(TRAINING, epochs=2, batch_size=batch_size))
    assert found.seen == 2 * 64 * 4


@pytest.mark.slow
def test_focus_gets_right_what_is_alike_and_all_data_neither():
    focus, everything = adapted(), adapted(method="all_data")
    assert float(focus.dynamics.slope) == pytest.approx(FREE, abs=0.03)
    assert float(everything.dynamics.slope) == pytest.approx((FREE + STUCK) / 2, abs=0.1)
    assert 0.5 <= focus.similar < 0.7  # the free half, and the shortest moves of what is stuck
    assert everything.similar < focus.similar


def test_every_member_of_an_ensemble_adapts_on_its_own():
    dynamics = Ensemble(Slope(jnp.array([1.0, 1.1])))
    found = adapted(dynamics=dynamics)
    assert isinstance(found.dynamics, Ensemble)
    np.testing.assert_allclose(found.dynamics.members.slope, FREE, atol=0.03)
    assert (np.asarray(dynamics.members.slope) == np.array([1.0, 1.1], np.float32)).all()  # as they were


@pytest.mark.parametrize("method", ["low_initial_error", "hard_initial_error"])
def test_initial_errors_weigh_once_and_for_all(method):
    ready = problem(method=method).after(Progress(jnp.asarray(10), jnp.asarray(3000)))
    initial = jnp.array([0.1, 0.3])
    now = [ready.weights(error, initial).tolist() for error in (jnp.zeros(2), jnp.ones(2))]
    assert now[0] == now[1]
    assert now[0][0] > 0.9 and now[0][1] < 0.1


def test_learning_goes_on_with_sharp_weights():
    data = moves(64)
    epochs = []
    first = adapted(data)
    adapt(
        first.dynamics,
        data,
        GAMMA,
        replace(CONFIG, fit=replace(TRAINING, epochs=1)),
        seed=1,
        seen=first.seen,
        report=lambda number, count, metrics: epochs.append(metrics),
    )
    bins = [float(epochs[0][f"validation_weights_in_bin_{i}"][0]) for i in range(BINS)]
    assert sum(bins) == pytest.approx(1, abs=1e-5)
    assert bins[0] + bins[-1] > 0.9  # nearly all weights are near 0 or 1
    assert first.seen == TRAINING.epochs * 64 * 4


def test_more_data_compile_nothing_anew():
    traced = []

    class Counted(Slope):
        def __call__(self, obstacles, state, action):
            traced.append(1)
            return super().__call__(obstacles, state, action)

    dynamics = Counted(jnp.ones(()))
    config = replace(CONFIG, steps=4, fit=replace(TRAINING, epochs=2))
    counts = []
    for count in (8, 20):
        adapt(dynamics, moves(count), GAMMA, config, seed=0, capacity=128)
        counts.append(len(traced))
    assert counts[0] == counts[1]


def test_gamma_is_a_quantile_of_the_sources_own_errors():
    data = moves(200, length=1, factor=1.3)
    config = replace(CONFIG, quantile=0.9)
    expected = np.quantile(0.3 * np.abs(np.asarray(data.actions)), 0.9)
    assert similarity_threshold(source(), data, config) == pytest.approx(expected, rel=1e-3)
    both = similarity_threshold(Ensemble(Slope(jnp.array([1.0, 1.3]))), data, replace(config, quantile=0.75))
    assert both == pytest.approx(np.quantile(0.3 * np.abs(np.asarray(data.actions)), 0.5), rel=0.05)


def test_what_cannot_be_adapted_to():
    stuck = moves(64, factor=-50.0)
    with pytest.raises(ValueError, match=r"none of 256 transitions .* below gamma = 1e-07 m"):
        adapted(stuck, gamma=1e-7, method="hard_initial_error")
    soft = adapted(stuck, gamma=1e-7)  # told, not refused: weights begin soft
    assert soft.similar == 0.0
    with pytest.raises(ValueError, match="gamma is nan, expected a positive length"):
        adapted(gamma=float("nan"))
    with pytest.raises(ValueError, match="there are no trajectories"):
        adapted([])
    sound = moves(4)
    holed = eqx.tree_at(lambda data: data.states.x, sound, sound.states.x.at[0, 1].set(jnp.nan))
    with pytest.raises(ValueError, match="values that are not finite"):
        adapted(holed)
    with pytest.raises(ValueError, match=r"errors is 0\.0: no gamma"):
        similarity_threshold(source(), exact(), CONFIG)


def exact():
    """Nothing is done, and nothing moves."""
    still = moves(8)
    return eqx.tree_at(
        lambda data: (data.states.x, data.actions),
        still,
        (jnp.zeros_like(still.states.x), jnp.zeros_like(still.actions)),
    )


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"horizon": 0}, "horizon is 0"),
        ({"quantile": 1.0}, "quantile is 1.0, expected a number between 0 and 1"),
        ({"growth": -1.0}, "growth is -1.0, expected at least 0"),
    ],
)
def test_settings_that_weigh_nothing(changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        AdaptationConfig(**changes)
