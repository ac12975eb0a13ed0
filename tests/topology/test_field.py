"""The magnetic field of a loop: closed forms, quadrature, gradients, and its direction."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.topology import field_line, linking_number, magnetic_field

from . import curves

SQUARE = curves.closed([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])  # counter-clockwise seen from above

fields = jax.jit(jax.vmap(magnetic_field, (None, 0)))


def quadrature(loop, point, count=4000):
    """Biot and Savart by the midpoint rule, in double precision."""
    total = np.zeros(3)
    for start, end in itertools.pairwise(loop):
        middles = start + (np.arange(count)[:, None] + 0.5) / count * (end - start)
        apart = point - middles
        cube = np.linalg.norm(apart, axis=1, keepdims=True) ** 3
        total += np.sum(np.cross((end - start) / count, apart) / cube, axis=0)
    return total / (4 * np.pi)


def test_the_field_in_the_middle_of_a_square_is_right_handed_and_known():
    # B = 2 sqrt(2) mu I / (pi a) for a square of side a.
    middle = magnetic_field(jnp.array(SQUARE), jnp.zeros(3))
    np.testing.assert_allclose(middle, [0, 0, 2 * np.sqrt(2) / (np.pi * 2)], atol=1e-6)
    np.testing.assert_allclose(magnetic_field(jnp.array(SQUARE[::-1]), jnp.zeros(3)), -middle, atol=1e-6)


def test_on_the_axis_of_a_circle():
    circle = jnp.array(curves.circle(radius=0.5, count=2000))
    heights = np.linspace(-2, 2, 9)
    points = np.stack([np.zeros(9), np.zeros(9), heights], axis=1)
    expected = 0.5**2 / (2 * (0.5**2 + heights**2) ** 1.5)
    np.testing.assert_allclose(fields(circle, points)[:, 2], expected, rtol=2e-5)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_random_loop_agrees_with_quadrature(seed):
    rng = np.random.default_rng(seed)
    loop = curves.closed(rng.normal(size=(6, 3)))
    points = 2 * rng.normal(size=(4, 3))
    exact = np.stack([quadrature(loop, point) for point in points])
    scale = np.linalg.norm(exact, axis=1, keepdims=True) + 1e-2
    np.testing.assert_array_less(np.abs(fields(loop, points) - exact) / scale, 2e-4)


def test_around_a_linked_curve_the_field_sums_to_the_linking_number():
    circle = curves.circle(radius=1.0, centre=(1, 0, 0), axes=(0, 2), count=4000)
    steps, middles = np.diff(circle, axis=0), (circle[1:] + circle[:-1]) / 2
    work = float(np.sum(np.asarray(fields(SQUARE, middles)) * steps))
    assert work == pytest.approx(linking_number(circle, SQUARE), abs=1e-3)
    assert abs(work) == pytest.approx(1, abs=1e-3)


def test_the_released_code_has_the_opposite_direction():
    released = pytest.importorskip("h_signature.h_signature_np")
    points = np.array([[0, 0, 0.3], [0.4, 2, 1]])
    np.testing.assert_allclose(
        released.skeleton_field_dir(SQUARE, points), -fields(SQUARE, points), atol=1e-5
    )


@pytest.mark.parametrize("argument", [0, 1])
def test_gradients_agree_with_finite_differences(argument):
    with jax.enable_x64(True):
        at = [jnp.array(SQUARE), jnp.array([0.3, 0.2, 0.4])]
        along = np.random.default_rng(0).normal(size=at[argument].shape)

        def moved(step):
            return magnetic_field(*[x + step * along if i == argument else x for i, x in enumerate(at)])

        slope = jax.jvp(moved, (0.0,), (1.0,))[1]
        np.testing.assert_allclose(slope, (moved(1e-6) - moved(-1e-6)) / 2e-6, rtol=1e-7, atol=1e-9)
        backwards = jax.jacrev(magnetic_field, argnums=argument)(*at)
        axes = tuple(range(1, backwards.ndim))
        np.testing.assert_allclose(jnp.sum(backwards * along, axis=axes), slope, rtol=1e-12)


def test_points_on_the_wire_and_repeated_points_give_numbers():
    loop = jnp.array(SQUARE)
    on_wire = jnp.array([[1.0, 0.2, 0.0], [1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    assert np.isfinite(fields(loop, on_wire)).all()
    assert np.isfinite(jax.jacrev(magnetic_field, argnums=1)(loop, on_wire[0])).all()
    more = jnp.concatenate([loop, loop[-1:], loop[-1:]])
    np.testing.assert_array_equal(magnetic_field(more, jnp.ones(3)), magnetic_field(loop, jnp.ones(3)))


@pytest.mark.parametrize("point", [[0.5, 0, 1e-3], [0.5, 1e-4, 0], [1e4, 3e3, 2e3]])
def test_single_precision_is_accurate_beside_a_long_wire_and_far_away(point):
    # Near the middle of a long segment and far from a small loop, terms cancel.
    loop = curves.closed([[-50, 0, 0], [50, 0, 0], [50, 80, 0], [-50, 80, 0]])
    with jax.enable_x64(True):
        double = np.asarray(magnetic_field(jnp.array(loop), jnp.array(point)))
    single = np.asarray(fields(loop.astype(np.float32), np.float32([point]))[0])
    assert np.linalg.norm(single - double) < 2e-4 * np.linalg.norm(double)


def test_a_field_line_follows_the_field_through_the_loop_and_back_to_its_start():
    start = jnp.array([0.8, 0.0, 0.0])
    line = np.asarray(jax.jit(lambda x: field_line(jnp.array(SQUARE), x, step=0.02, count=150))(start))
    assert line.shape == (151, 3)
    np.testing.assert_array_equal(line[0], start)
    np.testing.assert_allclose(np.linalg.norm(np.diff(line, axis=0), axis=1), 0.02, rtol=1e-3)
    assert line[5, 2] > 0.08, "up, along the field"
    away = np.linalg.norm(line - line[0], axis=1)
    back = 30 + np.argmin(away[30:])
    assert away[back] < 0.02, "field lines are closed here"
    loop = np.concatenate([line[:back], line[:1]])
    assert linking_number(loop, SQUARE) == 1
    against = field_line(jnp.array(SQUARE), start, step=-0.02, count=1)
    assert against[1, 2] < 0
