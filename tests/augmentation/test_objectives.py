"""Terms beside hand-worked numbers, and their derivatives beside finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.augmentation.objectives import (
    Bands,
    Weights,
    box_excess,
    distance_change,
    occupancy_excess,
    robot_contact,
)
from doojax.augmentation.projection import Problem, ProjectionConfig, objective
from doojax.geometry.frames import quaternion_from_rotation_vector, quaternion_from_yaw, rotate
from doojax.geometry.motion import RigidMotion
from doojax.types import RopeState

from .problems import lying_rope, obstacles


def test_terms_by_hand():
    points = jnp.array([[1.2, 0.0, 0.0], [0.0, -0.3, 0.5]])
    low, high = jnp.array([-1.0, -0.2, 0.0]), jnp.array([1.0, 0.2, 0.4])
    excess = [box_excess(points[:, axis], low[axis], high[axis]).sum() for axis in range(3)]
    assert [float(one) for one in excess] == pytest.approx([0.2, 0.1, 0.1])
    thesis = Bands(low=jnp.array([0.0, -jnp.inf]), high=jnp.array([jnp.inf, 0.0]))
    # one that was outside is 3 cm deep, one that was inside is 5 cm away: equation 3.5 sums both
    assert float(occupancy_excess(jnp.array([-0.03, 0.05]), thesis).sum()) == pytest.approx(0.08)
    assert float(distance_change(jnp.array(0.1), jnp.array(0.3))) == pytest.approx(0.04)
    assert float(distance_change(jnp.array(0.1), jnp.array(0.3), 0.15)) == pytest.approx(0.0025)
    gaps = jnp.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]])
    assert float(robot_contact(gaps, jnp.zeros((2, 3)))) == pytest.approx(0.05)


def test_what_touched_may_not_be_pressed_in():
    bands = Bands.of(jnp.array([0.0005, 0.0005, -0.003, 0.2]), skin=0.001)
    after = jnp.array([-0.02, 0.0005, -0.0035, 0.0005])
    excess = np.array(occupancy_excess(after, bands))
    np.testing.assert_allclose(excess, [0.019, 0.0, 0.0, 0.0005], atol=5e-6)


def test_gradients_agree_with_finite_differences():
    names = ("box", "validity", "occupancy", "distance", "robot")
    with jax.enable_x64(True):
        problem = lying_rope(jnp.float64)
        low = jnp.full(3, -0.04)
        problem = Problem(
            problem.points, problem.radii, problem.obstacles, low, -low, problem.low, problem.high
        )
        fixed = jnp.array([0.1, -0.2, 0.0, 0.1, 0.0, 0.3])

        def gap(parameters):
            moved = RigidMotion.of(parameters, problem.centre).points(problem.points[:2])
            return robot_contact(problem.points[:2], moved)

        evaluate = objective(
            problem,
            ProjectionConfig(distance_tolerance=0.001),
            validity=lambda parameters: ((parameters - fixed) ** 2).sum(),
            robot=gap,
        )

        def values(at):
            terms = evaluate(at)[0]
            return jnp.stack([getattr(terms, name) for name in names])

        places, step = np.random.default_rng(0).uniform(-0.2, 0.2, (12, 6)), 1e-6
        slopes = np.asarray(jax.jit(jax.vmap(jax.jacrev(values)))(places))
        beside = places[:, None, None] + step * np.stack([np.eye(6), -np.eye(6)])
        found = np.asarray(jax.jit(jax.vmap(values))(beside.reshape(-1, 6))).reshape(12, 2, 6, 5)
        expected = np.moveaxis(found[:, 0] - found[:, 1], -1, 1) / (2 * step)
        np.testing.assert_allclose(slopes, expected, atol=2e-5)
        tried = (np.abs(expected).max(-1) > 1e-3).sum(0)
        assert (tried >= 3).all(), dict(zip(names, tried, strict=True))  # else nothing was compared


def test_the_sum_is_weighted():
    terms, _ = objective(lying_rope(), ProjectionConfig())(jnp.array([0.0, 0.0, -0.02, 0.0, 0.0, 0.0]))
    total = 0.05 * terms.box + terms.validity + terms.occupancy + 0.1 * terms.distance + terms.robot
    assert float(terms.occupancy) > 0
    assert float(terms.total(Weights())) == pytest.approx(float(total))


def test_rotation_vectors():
    yaw = quaternion_from_rotation_vector(jnp.array([0.0, 0.0, 0.7]))
    np.testing.assert_allclose(yaw, quaternion_from_yaw(jnp.array(0.7)), atol=1e-7)
    # both sides of where the series ends
    for length in (0.999e-3, 1.001e-3):
        vector = length * jnp.array([0.6, 0.0, 0.8])
        exact = [np.cos(length / 2), *(np.sin(length / 2) * np.array([0.6, 0.0, 0.8]))]
        np.testing.assert_allclose(quaternion_from_rotation_vector(vector), exact, rtol=2e-7, atol=1e-12)
    slope = jax.jacobian(quaternion_from_rotation_vector)(jnp.zeros(3))
    np.testing.assert_allclose(slope, np.vstack([np.zeros(3), np.eye(3) / 2]))


def test_a_moved_rope():
    """A quarter turn about (1, 0, 0), then up: places turn about the centre, displacements only turn."""
    state = RopeState(
        points=jnp.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), grippers=jnp.array([[1.0, 3.0, 0.0]])
    )
    motion = RigidMotion.of(jnp.array([0.0, 0.0, 0.5, 0.0, 0.0, jnp.pi / 2]), jnp.array([1.0, 0.0, 0.0]))
    moved = state.moved(motion)
    np.testing.assert_allclose(moved.points, [[1.0, 0.0, 0.5], [1.0, 1.0, 0.5]], atol=1e-6)
    np.testing.assert_allclose(moved.grippers, [[-2.0, 0.0, 0.5]], atol=1e-6)
    np.testing.assert_allclose(motion.vectors(jnp.array([[0.1, 0.0, 0.2]])), [[0.0, 0.1, 0.2]], atol=1e-7)
    turned = rotate(motion.quaternion, state.grippers) + motion.about_origin
    np.testing.assert_allclose(turned, moved.grippers, atol=1e-6)
    nothing = state.moved(RigidMotion.of(jnp.zeros(6), jnp.array([0.1, 0.3, 0.7])))
    np.testing.assert_array_equal(nothing.points, state.points)


def test_an_example_is_within_its_own_bands():
    problem = lying_rope()
    _, fails = objective(problem, ProjectionConfig())(jnp.zeros(6))
    assert not np.array(fails).any()
    assert obstacles().kind.shape == (2,)
