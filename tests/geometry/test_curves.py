import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from doojax import geometry
from doojax.geometry import arc_lengths, catenary, clamped_elastica, resample

properties = settings(max_examples=20, deadline=None)
seeds = st.integers(0, 2**32 - 1)
hang = jax.jit(catenary, static_argnums=3)
resampled = jax.jit(resample, static_argnums=1)
curvatures, turning_angles = jax.jit(geometry.curvatures), jax.jit(geometry.turning_angles)


def resample_to_20(points):
    return resampled(points, 20)


def circle(radius, count, angle):
    t = np.linspace(0, angle, count)
    return jnp.asarray(np.stack([radius * np.cos(t), radius * np.sin(t), 0 * t + 0.3], axis=-1), float)


def test_arc_length_of_a_known_polyline():
    points = jnp.array([[0, 0, 0], [3, 4, 0], [3, 4, 2], [3, 4, 2], [2, 4, 2]], float)
    np.testing.assert_allclose(arc_lengths(points), [0, 5, 7, 7, 8])


def test_resample_of_a_straight_line_is_even_whatever_its_points():
    along = jnp.array([0, 0.1, 0.1, 0.7, 2])  # one segment has no length
    points = along[:, None] * jnp.array([[1.0, -2, 2]])
    np.testing.assert_allclose(arc_lengths(resampled(points, 7)), jnp.linspace(0, 6, 7), atol=1e-6)


def test_resample_keeps_ends_and_stays_on_the_polyline():
    points = jnp.array([[0, 0, 0], [1, 0, 0], [1, 1, 0]], float)
    expected = [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1, 0.5, 0], [1, 1, 0]]
    np.testing.assert_allclose(resampled(points, 5), expected, atol=1e-6)


def test_resample_of_copies_of_one_point():
    points = jnp.ones((8, 3))
    np.testing.assert_array_equal(resample_to_20(points), jnp.ones((20, 3)))
    slope = jax.jit(jax.jacfwd(resample_to_20))(points)
    assert jnp.all(jnp.isfinite(slope))


@properties
@given(seeds)
def test_resample_commutes_with_translation_and_reversal(seed):
    points = jnp.asarray(np.random.default_rng(seed).normal(size=(8, 3)), float)
    plain = resample_to_20(points)
    np.testing.assert_allclose(resample_to_20(points + 1), plain + 1, atol=2e-5)
    np.testing.assert_allclose(resample_to_20(points[::-1])[::-1], plain, atol=2e-5)
    assert arc_lengths(plain)[-1] <= arc_lengths(points)[-1] + 1e-5


def test_resample_gradient_equals_finite_differences():
    with jax.enable_x64(True):
        points = jnp.asarray(np.random.default_rng(0).normal(size=(6, 3)))
        step = jnp.asarray(np.random.default_rng(1).normal(size=(6, 3)))
        moved = jax.jit(lambda p, s: jax.jvp(resample_to_20, (p,), (s,))[1])(points, step)
        numeric = (resample_to_20(points + 1e-6 * step) - resample_to_20(points - 1e-6 * step)) / 2e-6
        np.testing.assert_allclose(moved, numeric, atol=1e-7)


@pytest.mark.parametrize("points, count", [(np.zeros((1, 3)), 5), (np.zeros((4, 3)), 1)])
def test_resample_needs_two_points(points, count):
    with pytest.raises(ValueError, match=rf"resample {len(points)} points to {count}: both must be at least"):
        resample(jnp.asarray(points, float), count)


def test_turning_angles_and_curvature_of_a_circle_are_exact():
    points = circle(0.4, 16, 1.5 * np.pi)
    np.testing.assert_allclose(turning_angles(points), 0.1 * np.pi, atol=2e-6)
    np.testing.assert_allclose(curvatures(points), 2.5, rtol=1e-5)


def test_straight_right_angle_and_folded_corners():
    points = jnp.array([[0, 0, 0], [2, 0, 0], [4, 0, 0], [4, 2, 0], [4, 0, 0]], float)
    np.testing.assert_allclose(turning_angles(points), [0, np.pi / 2, np.pi], atol=1e-6)
    np.testing.assert_allclose(curvatures(points), [0, np.sqrt(2) / 2, 1], atol=1e-6)
    slope = jax.jit(jax.grad(lambda p: curvatures(p).sum() + turning_angles(p).sum()))(points[:4])
    assert jnp.all(jnp.isfinite(slope))


def catenary_by_bisection(start, end, length, count):
    across = np.asarray(end, float) - start
    span, rise = np.hypot(across[0], across[1]), across[2]
    ratio = np.sqrt(length**2 - rise**2) / span
    x = brentq(lambda x: np.log(np.sinh(x) / x / ratio), 1e-9, 100, xtol=1e-15)
    a, lowest = span / (2 * x), np.arctanh(rise / length) - x
    u = np.sinh(lowest) + np.linspace(0, 1, count) * length / a
    forward, up = np.arcsinh(u) - lowest, np.sqrt(1 + u**2) - np.cosh(lowest)
    return start + a * np.stack([forward * across[0] / span, forward * across[1] / span, up], axis=-1)


@properties
@given(seeds, st.floats(1.001, 50))
def test_catenary_equals_bisection_in_double_precision(seed, slack):
    rng = np.random.default_rng(seed)
    start, end = np.float32(rng.uniform(-1, 1, (2, 3)))
    end[0] += 0.1 + 2 * (end[0] > start[0])  # not quite one above the other
    length = np.float32(slack * np.linalg.norm(end - start))
    ours = hang(jnp.asarray(start), jnp.asarray(end), jnp.asarray(length), 33)
    expected = catenary_by_bisection(start, end, float(length), 33)
    np.testing.assert_allclose(ours, expected, atol=5e-6 * length)
    np.testing.assert_array_equal(ours[-1], end)


def test_catenary_sag_of_a_level_rope():
    """0.8 m between grippers 0.5 m apart: a = 0.1176 m from sinh(x) / x = 1.6, sag a (cosh(x) - 1)."""
    points = hang(jnp.array([-0.25, 0, 1]), jnp.array([0.25, 0, 1]), 0.8, 51)
    x = brentq(lambda x: np.sinh(x) / x - 1.6, 0.1, 10)
    np.testing.assert_allclose(1 - points[25, 2], 0.25 / x * (np.cosh(x) - 1), atol=1e-6)
    np.testing.assert_allclose(points[25, :2], 0, atol=1e-6)


def test_catenary_between_ends_one_above_the_other_is_a_fold():
    points = hang(jnp.array([1.0, 2, 3]), jnp.array([1.0, 2, 2.8]), 1.0, 11)
    np.testing.assert_allclose(points[:, :2], [[1, 2]] * 11, atol=1e-5)
    down = jnp.linspace(0, 1, 11)
    np.testing.assert_allclose(points[:, 2], 3 - jnp.where(down <= 0.6, down, 1.2 - down), atol=1e-5)


def test_catenary_shorter_than_the_gap_is_straight():
    start, end = jnp.zeros(3), jnp.array([0.0, 3, 4])
    points = hang(start, end, 4.5, 6)
    np.testing.assert_allclose(points, jnp.linspace(0, 1, 6)[:, None] * end, atol=1e-6)


def test_catenary_needs_both_ends():
    with pytest.raises(ValueError, match="count is 1: expected at least two"):
        catenary(jnp.zeros(3), jnp.ones(3), 2.0, 1)


@pytest.mark.parametrize("limpness", [1.0, 10.0, 100.0, 1000.0])
def test_elastica_equals_a_collocation_solution(limpness):
    length, weight = 0.7, 2.0
    points = clamped_elastica(length, weight * length**3 / limpness, weight, 41)

    s, theta = np.linspace(0, 1, 50), np.zeros((2, 50))
    for load in np.geomspace(1, limpness, 5):  # the limp solution is found by following the stiff one
        solution = solve_bvp(
            lambda s, y, load=load: [y[1], load * (1 - s) * np.cos(y[0])],
            lambda clamp, tip: [clamp[0], tip[1]],
            s,
            theta,
            tol=1e-8,
            max_nodes=20_000,
        )
        s, theta = solution.x, solution.y
    fine = np.linspace(0, 1, 40_001)
    inclination = solution.sol(fine)[0]
    sign = np.sign(inclination[-1])  # the sign of gravity in the reference is free
    expected = length * np.array(
        [np.trapezoid(np.cos(inclination), fine), 0, sign * -np.trapezoid(np.sin(inclination), fine)]
    )
    np.testing.assert_allclose(points[-1], expected, atol=1e-7)


def test_stiff_elastica_is_a_linear_beam():
    points = clamped_elastica(2.0, 100.0, 0.01, 11)
    s = np.linspace(0, 2, 11)
    linear = -0.01 / (24 * 100) * s**2 * (s**2 - 4 * 2 * s + 6 * 4)
    np.testing.assert_allclose(points[:, 2], linear, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(points[:, 0], s, atol=1e-6)


def test_limp_elastica_hangs_down():
    points = clamped_elastica(1.0, 1e-5, 1.0, 101)
    assert points[-1, 2] < -0.995
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1)[10:], 0.01, atol=1e-6)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((0.0, 1.0, 1.0, 5), "length 0.0, .*expected positive numbers"),
        ((1.0, -1.0, 1.0, 5), "bending stiffness -1.0"),
        ((1.0, 1.0, 1.0, 1), "count 1: expected at least two"),
        ((1.0, 1e-9, 1.0, 5), r"w length\^3 / EI is 1e\+09, expected"),
    ],
)
def test_elastica_refuses_bad_ropes(arguments, message):
    with pytest.raises(ValueError, match=message):
        clamped_elastica(*arguments)
