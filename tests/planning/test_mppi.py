"""MPPI beside LQR and the closed form of its mean; swing-ups; errors."""

import re
from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from doojax.planning import Mppi, MppiSettings, Risk, rolled_out, timed_rolled_out
from doojax.planning.costs import final, summed
from doojax.planning.mppi import PRESETS, unwound

# A mass on a line, pushed: position and velocity, steps of 0.1 s.
A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
Q, R = np.diag([1.0, 0.1]), np.array([[0.1]])
P = solve_discrete_are(
    A, B, Q, R
)  # the cost to go, which makes a short horizon's optimum that of an endless one
GAIN = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
START = np.array([0.6, -0.3])
STATE = jnp.asarray(START, jnp.float32)
LINEAR = MppiSettings(samples=64, horizon=4, temperature=0.02, noise=0.5)
TERMS = {
    "on the way": lambda states, controls: (states[:-1] ** 2 @ np.diag(Q)).sum(),
    "push": summed(lambda state, control: R[0, 0] * (control**2).sum()),
    "to go": final(lambda state: state @ P.astype(np.float32) @ state),
}
TRACES = []  # one entry whenever the step is traced


def push(state, control):
    TRACES.append(1)
    return A.astype(np.float32) @ state + B.astype(np.float32) @ control


def linear(settings=LINEAR, terms=TERMS, low=(-np.inf,), high=(np.inf,)) -> Mppi:
    return Mppi(rolled_out(push), terms, low, high, settings)


LQ = linear()
RUN = jax.jit(LQ)


def keys(count, seed=0):
    return jax.random.split(jax.random.key(seed), count)


def quadratic(horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """Hessian and minimum of the cost of controls [H], by matrices."""
    free = np.concatenate([np.linalg.matrix_power(A, i + 1) @ START for i in range(horizon)])
    forced = np.zeros((2 * horizon, horizon))
    for i in range(horizon):
        for j in range(i + 1):
            forced[2 * i : 2 * i + 2, j] = (np.linalg.matrix_power(A, i - j) @ B)[:, 0]
    weights = np.zeros((2 * horizon, 2 * horizon))
    for i in range(horizon):
        weights[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = P if i == horizon - 1 else Q
    hessian = 2 * (forced.T @ weights @ forced + R[0, 0] * np.eye(horizon))
    return hessian, -np.linalg.solve(hessian, 2 * forced.T @ weights @ free)


def test_the_first_control_goes_to_lqrs_as_samples_grow():
    errors = []
    for samples in (16, 128, 1024):
        controller = linear(replace(LINEAR, samples=samples))

        def refined(key, controller=controller):
            def improve(i, nominal):
                return controller(nominal, STATE, jax.random.fold_in(key, i))[0]

            return jax.lax.fori_loop(0, 15, improve, controller.start()).controls

        found = jax.jit(jax.vmap(refined))(keys(8))[:, 0, 0]
        errors.append(float(np.sqrt(np.mean((found + (GAIN @ START)[0]) ** 2))))
    first = abs((GAIN @ START)[0])
    # noise of a mean falls with the root of the samples, to a third each time
    assert errors[1] < 0.6 * errors[0] and errors[2] < 0.6 * errors[1], errors
    assert errors[2] < 0.02 * first, errors


def test_lqrs_control_is_the_least_of_the_cost():
    assert quadratic(8)[1][0] == pytest.approx(-(GAIN @ START)[0], rel=1e-9)


def test_one_improvement_is_the_mean_of_a_gaussian_times_a_gaussian():
    """exp(-cost / temperature) times the samples' density is Gaussian again, and its mean is known."""
    settings = replace(LINEAR, samples=200_000, horizon=2, temperature=0.3)
    controller = linear(settings)
    hessian, best = quadratic(2)
    found, report = jax.jit(controller)(controller.start(), STATE, jax.random.key(1))
    precision = np.eye(2) / settings.noise**2 + hessian / settings.temperature
    expected = np.linalg.solve(precision, hessian @ best / settings.temperature)
    assert np.abs(expected).min() > 0.05
    assert found.controls[:, 0] == pytest.approx(expected, abs=4e-3)
    assert float(report.weights.sum()) == pytest.approx(1, abs=1e-4)
    by_hand = START
    for control in np.asarray(report.samples.controls[7], float):
        by_hand = A @ by_hand + B @ control
    assert report.states[7, -1] == pytest.approx(by_hand, abs=1e-5)
    assert float(report.terms["to go"][7]) == pytest.approx(by_hand @ P @ by_hand, rel=1e-4)


def test_bounds_hold_and_what_they_exclude_is_not_commanded():
    controller = linear(low=(0.2,), high=(0.4,))  # LQR would push the other way
    assert (GAIN @ START)[0] > 0
    nominal = controller.start()
    assert nominal.controls == pytest.approx(0.2)
    run = jax.jit(controller)
    for key in keys(5):
        nominal, report = run(nominal, STATE, key)
    low, high = float(report.samples.controls.min()), float(report.samples.controls.max())
    assert np.float32(0.2) == np.float32(low) and high <= np.float32(0.4)
    assert 0.2 <= float(nominal.controls[0, 0]) < 0.25


def swing(state, control):
    """A pendulum, one kilogram on one metre, upright at 0; it takes several swings to get up."""
    angle, speed = state
    speed = jnp.clip(speed + 0.05 * (15 * jnp.sin(angle) + 3 * control[0]), -8, 8)
    return jnp.stack([angle + 0.05 * speed, speed])


def test_a_pendulum_swings_up_inside_a_users_own_jit():
    terms = {
        "angle": summed(lambda state, control: 1 - jnp.cos(state[0])),
        "speed": summed(lambda state, control: 0.01 * state[1] ** 2),
    }
    settings = MppiSettings(samples=128, horizon=25, temperature=0.2, noise=1.0)
    controller = Mppi(rolled_out(swing), terms, [-2.0], [2.0], settings)

    @eqx.filter_jit
    def controlled(controller, key):
        def live(carry, time):
            state, nominal = carry
            nominal, _ = controller(nominal, state, jax.random.fold_in(key, time))
            state = swing(state, nominal.controls[0])
            return (state, nominal.advanced()), state

        begin = jnp.array([jnp.pi, 0.0]), controller.start()
        return jax.lax.scan(live, begin, jnp.arange(120))[1]

    states = eqx.filter_vmap(controlled, in_axes=(None, 0))(controller, keys(4))
    height = jnp.cos(states[..., 0])
    assert (height[:, 0] < -0.9).all()
    assert (height[:, -20:] > 0.95).all(), height[:, -20:].min(1)
    # without several swings it could not be: the largest torque holds it at 24 degrees only
    assert (jnp.sign(states[:, 1:, 1]) != jnp.sign(states[:, :-1, 1])).sum(1).min() >= 2


def test_the_same_key_gives_the_same_plan_and_compiles_once():
    first, _ = RUN(LQ.start(), STATE, jax.random.key(3))
    before = len(TRACES)
    again, _ = RUN(LQ.start(), STATE, jax.random.key(3))
    other, _ = RUN(first.advanced(), STATE + 0.1, jax.random.key(4))
    assert len(TRACES) == before
    assert jnp.array_equal(first.controls, again.controls)
    assert not jnp.array_equal(first.controls, other.controls)


def test_noise_between_knots_is_as_large_and_changes_slowly():
    settings = replace(LINEAR, samples=20_000, horizon=9, knots=3)
    found = np.asarray(linear(settings).draw(linear(settings).start(), jax.random.key(2)).controls[..., 0])
    assert found.std(0) == pytest.approx(settings.noise, rel=0.03)
    alike = np.corrcoef(found.T)
    assert alike[0, 4] == pytest.approx(0, abs=0.03)  # knots know nothing of each other
    # a quarter of the way from one knot to the next: 3/4 of the one, 1/4 of the other
    assert alike[0, 1] == pytest.approx(0.75 / np.hypot(0.75, 0.25), abs=0.01)
    assert alike[1, 2] == pytest.approx((0.75 + 0.25) / (np.hypot(0.75, 0.25) * 2**0.5), abs=0.01)


def test_what_is_left_begins_with_the_second_control_and_ends_at_rest():
    nominal = eqx.tree_at(lambda n: n.controls, LQ.start(), jnp.arange(1.0, 5.0)[:, None])
    assert nominal.advanced().controls[:, 0].tolist() == [2, 3, 4, 0]


class Outside:
    """Rollouts that no tracer passes, as those of MuJoCo C."""

    def many(self, state, controls, durations):
        states = np.empty((*controls.shape[:2], 2), np.float32)
        for k, sample in enumerate(np.asarray(controls)):
            at = np.asarray(state)
            for h, control in enumerate(sample):
                at = A @ at + B @ control
                states[k, h] = at
        return jnp.asarray(states)


def test_rollouts_outside_of_jit_give_the_same_plan():
    outside = Mppi(Outside(), TERMS, LQ.low, LQ.high, LINEAR)
    expected = RUN(LQ.start(), STATE, jax.random.key(5))[0]
    found = outside(outside.start(), STATE, jax.random.key(5))[0]
    assert np.asarray(found.controls) == pytest.approx(np.asarray(expected.controls), abs=1e-5)
    with pytest.raises(ValueError, match="outside of jit, but MPPI is called inside"):
        jax.jit(outside)(outside.start(), STATE, jax.random.key(6))


def test_durations_and_noise_follow_what_was_good():
    """A point that is to get farther than it can: longer steps are better."""

    def glide(state, control, duration):
        return state + duration * control

    settings = replace(PRESETS["thesis"], samples=4096, horizon=4, temperature=0.02)
    assert (PRESETS["thesis"].samples, PRESETS["thesis"].horizon) == (50, 15)
    controller = Mppi(
        timed_rolled_out(glide),
        {"far": final(lambda state: (state[0] - 5) ** 2)},
        [0.4] * 2,
        [2.0] * 2,
        settings,
    )
    found, report = jax.jit(controller)(controller.start(), jnp.zeros(2), jax.random.key(0))
    durations = report.samples.durations
    assert durations.min() >= np.float32(0.1) and durations.max() <= np.float32(0.3)
    assert float(durations.mean()) == pytest.approx(0.2, abs=2e-3)
    assert float(durations.std()) == pytest.approx(0.03, rel=0.05)
    steps = durations[:, None, None] * report.samples.controls
    assert np.asarray(report.states) == pytest.approx(np.cumsum(np.asarray(steps), axis=1), abs=1e-5)
    assert 0.25 < float(found.duration) <= 0.3  # farther in longer steps
    square = (report.samples.controls - controller.start().controls) ** 2
    weights = np.asarray(report.weights, float)
    assert np.asarray(found.deviation) ** 2 == pytest.approx(
        weights @ np.asarray(square.mean(1), float), rel=1e-4
    )


def test_costs_of_several_rollouts_are_one_by_their_risk():
    costs = jnp.array([[4.0, 1.0, 3.0, 2.0], [0.0, 0.0, 0.0, 8.0]])
    assert Risk().of(costs).tolist() == [2.5, 2.0]
    assert Risk("worst").of(costs).tolist() == [4.0, 8.0]
    assert Risk("cvar", 0.5).of(costs).tolist() == [3.5, 4.0]
    # of 1.5 rollouts: the worst, and half of the next
    assert np.asarray(Risk("cvar", 0.375).of(costs)) == pytest.approx([(4 + 1.5) / 1.5, 8 / 1.5])
    with pytest.raises(ValueError, match=r"tail is 0\.0, expected a share"):
        Risk("cvar", 0.0)
    with pytest.raises(ValueError, match="risk is 'median', expected mean, worst or cvar"):
        Risk.__post_init__(SimpleNamespace(kind="median"))


def test_what_may_go_very_wrong_is_left_alone_by_those_who_look_at_the_worst():
    """A push of u gains u, or, one time in four, loses 8 u."""
    gains = jnp.array([-1.0, -1.0, -1.0, 8.0])

    def rollouts(state, controls, durations):
        return state + gains[None, :, None] * controls[:, None, :, 0]

    terms = {"cost": lambda states, controls: states.sum()}
    settings = replace(LINEAR, samples=512, horizon=1, temperature=0.1)
    found = {}
    for risk in (Risk(), Risk("worst"), Risk("cvar", 0.25)):
        controller = Mppi(rollouts, terms, [-1.0], [1.0], settings, risk)
        nominal, report = jax.jit(controller)(controller.start(), jnp.zeros(()), jax.random.key(0))
        found[risk.kind] = float(nominal.controls[0, 0])
        expected = report.samples.controls[:, 0, 0] * (-3 + 8) / 4
        assert np.asarray(report.terms["cost"]) == pytest.approx(np.asarray(expected), abs=1e-5)
        assert report.costs.shape == (512,)
    assert found["mean"] < -0.5  # it loses 5/4 u on average
    assert abs(found["worst"]) < 0.15 and found["worst"] == pytest.approx(found["cvar"], abs=1e-6)


def test_a_cost_that_is_nan_counts_for_nothing_and_is_named():
    terms = TERMS | {"root": lambda states, controls: jnp.sqrt(controls[0, 0])}
    controller = linear(terms=terms)
    run = jax.jit(controller)
    found, report = run(controller.start(), STATE, jax.random.key(0))
    bad = np.asarray(report.samples.controls[:, 0, 0] < 0)
    assert 0 < bad.sum() < 64
    assert int(report.unpriced()["root"]) == bad.sum() and int(report.unpriced()["push"]) == 0
    assert (np.asarray(report.weights) == 0)[bad].all() and jnp.isfinite(found.controls).all()
    assert float(report.weights.sum()) == pytest.approx(1, abs=1e-5)
    report.check()

    nominal = eqx.tree_at(lambda n: n.controls, controller.start(), jnp.full((4, 1), -9.0))
    kept, report = run(nominal, STATE, jax.random.key(0))
    assert jnp.array_equal(kept.controls, nominal.controls)
    with pytest.raises(ValueError, match=re.escape("by term: root (64 of 64). The plan is as it was")):
        report.check()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"horizon": 0}, "horizon is 0, expected 1 to 10,000"),
        ({"samples": 0}, "samples is 0, expected 1 to"),
        ({"knots": 21}, "knots is 21, expected 0 to the horizon, 20"),
        ({"temperature": 0.0}, "temperature is 0.0, expected positive"),
        ({"temperature": float("nan")}, "temperature is nan, expected positive"),
        ({"noise": (0.1, -1.0)}, "noise is (0.1, -1.0), expected positive"),
        ({"duration": 0.5, "duration_range": (0.1, 0.3)}, "duration is 0.5 s, expected"),
        ({"duration_noise": -1.0}, "duration_noise is -1.0 s"),
    ],
)
def test_settings_that_control_nothing_are_refused(change, complaint):
    with pytest.raises(ValueError, match=re.escape(complaint)):
        MppiSettings(**change)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"low": (0.0, 0.0)}, "low and high have shapes (2,) and (1,)"),
        ({"low": (1.0,), "high": (1.0,)}, "expected below high"),
        ({"settings": replace(LINEAR, noise=(0.1, 0.2))}, "noise has 2 numbers for 1 controls"),
        ({"terms": {}}, "there are no terms"),
    ],
)
def test_controllers_that_make_no_sense_are_refused(change, complaint):
    with pytest.raises(ValueError, match=re.escape(complaint)):
        linear(**change)


def test_a_command_runs_only_so_far_ahead():
    found = unwound(jnp.array([0.5, 0.51, -3.0]), jnp.array([0.5, 0.5, 0.5]))
    assert found == pytest.approx(np.array([0.5, 0.51, 0.48]))
