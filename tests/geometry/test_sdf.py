import inspect
import math
import operator
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from doojax.geometry import (
    FAR,
    nearest_obstacle,
    signed_distance,
    signed_distance_and_gradient,
    signed_distances,
)
from doojax.types import ShapeKind
from tests.geometry.shapes import KINDS, in_mujoco, obstacles_of, one_shape, random_obstacles

properties = settings(max_examples=20, deadline=None)
COUNT = 100  # points in most tests, so that what is compiled for one serves the others
LATTICE = np.stack(np.meshgrid(*[np.linspace(-0.4, 0.4, 9)] * 3), axis=-1).reshape(-1, 3)
seeds = st.integers(0, 2**32 - 1)

distance = jax.jit(signed_distance)
distances = jax.jit(signed_distances)
nearest = jax.jit(nearest_obstacle)
derived = jax.jit(jax.vmap(jax.grad(signed_distance, argnums=1), (None, 0)))


@jax.jit
def described(obstacles, points):
    """The distance and, in the three next columns, its written derivatives."""
    return jnp.stack(signed_distance_and_gradient(obstacles, *points.T), axis=-1)


def written(obstacles, points):
    return described(obstacles, points)[:, 1:]


both_gradients = pytest.mark.parametrize("gradient", [derived, written], ids=["derived", "written"])


@both_gradients
@pytest.mark.parametrize(
    "kind, half_size, point, expected, normal",
    [
        (ShapeKind.BOX, (0.1, 0.2, 0.3), (0.4, 0.0, 0.0), 0.3, (1, 0, 0)),
        (ShapeKind.BOX, (0.1, 0.2, 0.3), (0.4, 0.6, 0.0), 0.5, (0.6, 0.8, 0)),
        (ShapeKind.BOX, (0.1, 0.2, 0.3), (0.2, -0.4, 0.5), 0.3, (1 / 3, -2 / 3, 2 / 3)),
        (ShapeKind.BOX, (0.1, 0.2, 0.3), (0.01, -0.15, 0.0), -0.05, (0, -1, 0)),
        (ShapeKind.BOX, (0.1, 0.2, 0.3), (0.0, 0.2, 0.1), 0.0, (0, 1, 0)),
        (ShapeKind.CAPSULE, (0.1, 0.1, 0.3), (0.3, 0.4, 0.2), 0.4, (0.6, 0.8, 0)),
        (ShapeKind.CAPSULE, (0.1, 0.1, 0.3), (0.0, 0.3, -0.7), 0.4, (0, 0.6, -0.8)),
        (ShapeKind.CAPSULE, (0.1, 0.1, 0.3), (0.03, 0.04, 0.1), -0.05, (0.6, 0.8, 0)),
        (ShapeKind.CYLINDER, (0.1, 0.1, 0.3), (0.3, 0.4, 0.2), 0.4, (0.6, 0.8, 0)),
        (ShapeKind.CYLINDER, (0.1, 0.1, 0.3), (0.24, 0.32, -0.7), 0.5, (0.36, 0.48, -0.8)),
        (ShapeKind.CYLINDER, (0.1, 0.1, 0.3), (0.03, 0.04, 0.1), -0.05, (0.6, 0.8, 0)),
        (ShapeKind.CYLINDER, (0.1, 0.1, 0.3), (0.0, 0.0, 0.28), -0.02, (0, 0, 1)),
    ],
)
def test_closed_forms(kind, half_size, point, expected, normal, gradient):
    obstacles, points = one_shape(kind, half_size), jnp.full_like(LATTICE, jnp.array(point), float)
    np.testing.assert_allclose(distance(obstacles, points), expected, atol=1e-7)
    np.testing.assert_allclose(
        gradient(obstacles, points), jnp.full_like(points, jnp.array(normal)), atol=1e-6
    )


def test_equals_mujoco_inside_and_outside():
    rng = np.random.default_rng(1)
    obstacles = random_obstacles(rng)
    body = rng.uniform(-1.3, 1.3, (30, 9, 3)) * (np.asarray(obstacles.half_size) + np.array([0, 0, 0.1]))
    turns = Rotation.from_quat(np.tile(obstacles.quaternion, (30, 1)), scalar_first=True)
    points = turns.apply(body.reshape(-1, 3)) + np.tile(obstacles.centre, (30, 1))
    ours = distances(obstacles, jnp.asarray(points, float))
    radius = 1e-3
    mujoco_distances = in_mujoco(obstacles, "sphere", [radius, 0, 0])
    theirs = np.array([mujoco_distances(point) for point in points]) + radius
    assert np.count_nonzero(theirs < 0) > 100
    np.testing.assert_allclose(ours, theirs, atol=2e-6)


@both_gradients
def test_gradient_has_unit_length_and_equals_finite_differences(gradient):
    rng = np.random.default_rng(2)
    with jax.enable_x64(True):
        obstacles = random_obstacles(rng)
        points = jnp.asarray(rng.uniform(-0.8, 0.8, (2000, 3)))
        slope = gradient(obstacles, points)
        np.testing.assert_allclose(jnp.linalg.norm(slope, axis=-1), 1, atol=1e-12)
        step = 1e-7 * jnp.eye(3)
        ahead, behind = (distance(obstacles, points[:, None] + s) for s in (step, -step))
        np.testing.assert_allclose(slope, (ahead - behind) / 2e-7, atol=1e-6)


@both_gradients
def test_gradient_in_float32_has_unit_length(gradient):
    rng = np.random.default_rng(3)
    obstacles = random_obstacles(rng)
    for points in rng.uniform(-0.8, 0.8, (50, COUNT, 3)):
        slope = gradient(obstacles, jnp.asarray(points, float))
        np.testing.assert_allclose(np.linalg.norm(slope, axis=-1), 1, atol=1e-5)


@both_gradients
@pytest.mark.parametrize("kind", list(ShapeKind))
def test_gradient_is_finite_on_kinks_faces_and_axes(kind, gradient):
    # the lattice holds its centre, axis, edges, corners and faces
    obstacles, lattice = one_shape(kind, (0.1, 0.1, 0.2)), jnp.asarray(LATTICE, float)
    slope = np.asarray(gradient(obstacles, lattice))
    assert np.all(np.linalg.norm(slope, axis=-1) <= 1 + 1e-6)
    outside = np.asarray(distance(obstacles, lattice)) > 1e-6
    np.testing.assert_allclose(np.linalg.norm(slope[outside], axis=-1), 1, atol=1e-6)


@jax.jit
def by_pose_and_size(obstacles, points):
    def reshaped(pose_and_size):
        changed = eqx.tree_at(lambda o: (o.centre, o.quaternion, o.half_size), obstacles, pose_and_size)
        return signed_distance(changed, points)

    return jax.jacfwd(reshaped)((obstacles.centre, obstacles.quaternion, obstacles.half_size))


@pytest.mark.parametrize("kind", list(ShapeKind))
def test_derivatives_by_pose_and_size_are_finite_there_too(kind):
    parts = by_pose_and_size(one_shape(kind, (0.1, 0.1, 0.2)), jnp.asarray(LATTICE, float))
    assert all(np.all(np.isfinite(part)) for part in parts)


@properties
@given(seeds)
def test_moving_everything_together_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    obstacles, points = random_obstacles(rng), rng.uniform(-0.8, 0.8, (COUNT, 3))
    turn, shift = Rotation.random(rng=rng), rng.uniform(-1, 1, 3)
    orientation = Rotation.from_quat(np.asarray(obstacles.quaternion), scalar_first=True)
    moved = obstacles_of(
        KINDS,
        turn.apply(np.asarray(obstacles.centre)) + shift,
        (turn * orientation).as_quat(scalar_first=True),
        obstacles.half_size,
    )
    before = distances(obstacles, jnp.asarray(points, float))
    after = distances(moved, jnp.asarray(turn.apply(points) + shift, float))
    np.testing.assert_allclose(after, before, atol=3e-6)


@properties
@given(seeds, st.floats(0.001, 2))
def test_distance_is_1_lipschitz(seed, reach):
    rng = np.random.default_rng(seed)
    obstacles, points = random_obstacles(rng), rng.uniform(-0.8, 0.8, (2, COUNT // 2, 3))
    points[1] = points[0] + reach * (points[1] - points[0])
    value = np.asarray(distance(obstacles, jnp.asarray(points.reshape(-1, 3), float))).reshape(2, -1)
    apart = np.linalg.norm(points[1] - points[0], axis=-1)
    assert np.all(np.abs(value[1] - value[0]) <= apart + 1e-6)


@both_gradients
@properties
@given(seeds)
def test_walking_down_the_gradient_reaches_the_surface(gradient, seed):
    rng = np.random.default_rng(seed)
    obstacles = random_obstacles(rng)
    points = rng.uniform(-0.8, 0.8, (COUNT, 3)).astype(np.float32)
    value = np.asarray(distance(obstacles, jnp.asarray(points)))
    surface = points - value[:, None] * np.asarray(gradient(obstacles, jnp.asarray(points)))
    near = np.asarray(nearest(obstacles, jnp.asarray(points)))
    landed = np.asarray(distances(obstacles, jnp.asarray(surface)))[np.arange(COUNT), near]
    np.testing.assert_allclose(landed, 0, atol=3e-6)


def test_inactive_obstacles_do_not_count():
    obstacles = random_obstacles(np.random.default_rng(4))
    points = jnp.asarray(np.random.default_rng(5).uniform(-0.8, 0.8, (COUNT, 3)), float)
    some = eqx.tree_at(lambda o: o.active, obstacles, jnp.arange(9) % 2 == 0)
    kept = jax.tree.map(lambda field: field[np.arange(0, 18, 2) % 10], obstacles)  # four of them twice
    np.testing.assert_allclose(distance(some, points), distance(kept, points), atol=1e-6)
    np.testing.assert_array_equal(nearest(some, points), 2 * nearest(kept, points))
    assert jnp.all(distances(some, points)[:, 1::2] == FAR)


@both_gradients
def test_no_active_obstacle_is_far_away_and_has_no_gradient(gradient):
    obstacles = random_obstacles(np.random.default_rng(4))
    parked = eqx.tree_at(lambda o: o.active, obstacles, jnp.zeros(9, bool))
    none = jax.tree.map(lambda field: field[:0], obstacles)
    points = jnp.ones((COUNT, 3))
    for empty in (parked, none):
        assert jnp.all(distance(empty, points) == FAR)
        assert jnp.all(nearest(empty, points) == -1)
        assert jnp.all(gradient(empty, points) == 0)


@both_gradients
def test_nearest_is_the_first_of_the_least_distances_and_nan_stays_nan(gradient):
    rng = np.random.default_rng(4)
    once = random_obstacles(rng)
    twice = jax.tree.map(lambda leaf: leaf[np.arange(9) % 5], once)  # all but one have an equal
    points = jnp.asarray(rng.uniform(-0.9, 0.9, (COUNT, 3)))
    np.testing.assert_array_equal(nearest(twice, points), distances(twice, points).argmin(-1))
    assert nearest(twice, points).max() < 5
    assert jnp.isnan(distance(once, points.at[7, 0].set(jnp.nan))).nonzero()[0].tolist() == [7]
    for field in ("centre", "half_size", "quaternion"):
        broken = eqx.tree_at(operator.attrgetter(field), once, replace_fn=lambda old: old.at[4].set(jnp.nan))
        assert (np.asarray(nearest(broken, points)) == 4).all()
        assert np.isnan(distance(broken, points)).all() and np.isnan(gradient(broken, points)).all()


@pytest.mark.parametrize("shape", [(), (3, 11)])
def test_the_written_gradient_comes_with_the_same_distance_in_any_shape(shape):
    rng = np.random.default_rng(7)
    obstacles, points = random_obstacles(rng), jnp.asarray(rng.uniform(-0.8, 0.8, (*shape, 3)), float)
    found, *slope = jax.jit(signed_distance_and_gradient)(obstacles, *jnp.moveaxis(points, -1, 0))
    again, count = np.resize(points, (COUNT, 3)), math.prod(shape)  # all of them, over and over
    np.testing.assert_allclose(np.ravel(found), distance(obstacles, again)[:count], atol=1e-7)
    flat = np.stack(slope, axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(flat, derived(obstacles, again)[:count], atol=1e-6)


def test_coordinates_of_different_shapes_are_refused_with_and_without_obstacles():
    x, y = jnp.zeros(()), jnp.zeros(3)
    unchecked = inspect.unwrap(signed_distance_and_gradient)  # in tests jaxtyping would refuse them before
    some = random_obstacles(np.random.default_rng(9))
    for obstacles in (some, jax.tree.map(lambda leaf: leaf[:0], some)):
        with pytest.raises(ValueError, match=r"shapes \(\), \(3,\) and \(3,\), expected one shape"):
            unchecked(obstacles, x, y, y)


def test_the_written_gradient_of_many_scenes_at_once_is_that_of_each():
    scenes = [random_obstacles(np.random.default_rng(seed)) for seed in range(3)]
    points = jnp.asarray(np.random.default_rng(3).uniform(-0.8, 0.8, (3, COUNT, 3)), float)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    together = jax.jit(jax.vmap(described))(stacked, points)
    each = [described(scene, point) for scene, point in zip(scenes, points, strict=True)]
    np.testing.assert_allclose(together, each, atol=1e-6)


@pytest.mark.slow
def test_the_written_gradient_can_itself_be_differentiated():
    obstacles, point = random_obstacles(np.random.default_rng(8)), jnp.array([0.7, 0.1, -0.6])

    def towards_x(point):
        return signed_distance_and_gradient(obstacles, *point)[1]

    twice = jax.jit(jax.hessian(lambda point: signed_distance(obstacles, point)))(point)
    np.testing.assert_allclose(jax.jit(jax.grad(towards_x))(point), twice[0], atol=1e-5)


def test_points_and_obstacles_of_different_precision_are_measured_in_the_finer():
    rng = np.random.default_rng(6)
    obstacles, points = random_obstacles(rng), jnp.asarray(rng.uniform(-0.9, 0.9, (20, 3)), jnp.float32)
    with jax.enable_x64(True):
        fine = jax.tree.map(lambda x: x.astype("float64") if x.dtype == jnp.float32 else x, obstacles)
        found = distance(fine, points)
        assert found.dtype == jnp.float64
        np.testing.assert_allclose(found, distances(fine, points).min(-1), atol=1e-12)


def test_moving_the_obstacle_is_moving_the_point_back():
    rng = np.random.default_rng(6)
    obstacles, point = random_obstacles(rng), jnp.asarray(rng.uniform(-0.8, 0.8, 3), float)

    def moved(shift):
        return signed_distance(eqx.tree_at(lambda o: o.centre, obstacles, obstacles.centre + shift), point)

    by_point = derived(obstacles, jnp.tile(point, (COUNT, 1)))[0]
    np.testing.assert_allclose(jax.jit(jax.grad(moved))(jnp.zeros(3)), -by_point, atol=1e-6)


def test_vmap_over_scenes_equals_a_loop():
    scenes = [random_obstacles(np.random.default_rng(seed)) for seed in range(3)]
    points = jnp.asarray(np.random.default_rng(7).uniform(-0.8, 0.8, (3, COUNT, 3)), float)
    batch = jax.tree.map(lambda *fields: jnp.stack(fields), *scenes)
    together = jax.jit(jax.vmap(signed_distance))(batch, points)
    apart = [distance(scene, p) for scene, p in zip(scenes, points, strict=True)]
    np.testing.assert_allclose(together, apart, atol=1e-6)
    with pytest.raises(ValueError, match=r"batch axes \(3,\).*jax\.vmap"):
        signed_distance(batch, points)


def test_new_poses_sizes_and_masks_compile_nothing_new():
    once = jax.jit(eqx.debug.assert_max_traces(signed_distance, max_traces=1))
    points = jnp.zeros((10, 3))
    for seed in range(4):
        obstacles = random_obstacles(np.random.default_rng(seed))
        once(eqx.tree_at(lambda o: o.active, obstacles, jnp.arange(9) > seed), points + seed)


@properties
@given(seed=seeds)
def test_an_obstacle_that_moves_counts_as_a_point_that_moves_the_other_way(seed):
    """By automatic differentiation of the distance; the points' gradient alone is the written one."""
    rng = np.random.default_rng(seed)
    obstacles, points = random_obstacles(rng), jnp.asarray(rng.uniform(-0.5, 0.5, (COUNT, 3)), jnp.float32)
    by_centre, by_point = moving(obstacles.centre, points, obstacles)
    np.testing.assert_allclose(by_centre.sum(1), -by_point, atol=2e-5)
    np.testing.assert_allclose(by_point, derived(obstacles, points), atol=2e-5)


@jax.jit
def moving(centre, points, obstacles):
    def one(centre, point):
        return signed_distance(replace(obstacles, centre=centre), point)

    return jax.vmap(jax.grad(one, (0, 1)), (None, 0))(centre, points)
