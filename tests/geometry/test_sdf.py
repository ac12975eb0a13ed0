import inspect
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from doojax.geometry import (
    FAR,
    nearest_obstacle,
    segment_signed_distance,
    signed_distance,
    signed_distance_and_gradient,
    signed_distances,
)
from doojax.types import Obstacles, ShapeKind

KINDS = [ShapeKind.BOX, ShapeKind.CAPSULE, ShapeKind.CYLINDER] * 3
MUJOCO_KINDS = {
    ShapeKind.BOX: mujoco.mjtGeom.mjGEOM_BOX,
    ShapeKind.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    ShapeKind.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}
properties = settings(max_examples=20, deadline=None)
seeds = st.integers(0, 2**32 - 1)

distance = jax.jit(signed_distance)
distances = jax.jit(signed_distances)
nearest = jax.jit(nearest_obstacle)
segment_distance = jax.jit(segment_signed_distance)
derived = jax.jit(jax.vmap(jax.grad(signed_distance, argnums=1), (None, 0)))


@jax.jit
def written(obstacles, points):
    return jnp.stack(signed_distance_and_gradient(obstacles, *points.T)[1:], axis=-1)


both_gradients = pytest.mark.parametrize("gradient", [derived, written], ids=["derived", "written"])


def random_obstacles(rng, kinds=KINDS):
    half_size = rng.uniform(0.02, 0.3, (len(kinds), 3))
    round_shape = np.array(kinds) != ShapeKind.BOX
    half_size[round_shape, 1] = half_size[round_shape, 0]
    return obstacles_of(
        kinds,
        rng.uniform(-0.6, 0.6, (len(kinds), 3)),
        Rotation.random(len(kinds), rng=rng).as_quat(scalar_first=True),
        half_size,
    )


def obstacles_of(kinds, centre, quaternion, half_size):
    return Obstacles(
        kind=jnp.array(kinds, int),
        centre=jnp.asarray(centre, float),
        quaternion=jnp.asarray(quaternion, float),
        half_size=jnp.asarray(half_size, float),
        active=jnp.ones(len(kinds), bool),
    )


def one_shape(kind, half_size):
    return obstacles_of([kind], [[0, 0, 0]], [[1, 0, 0, 0]], [half_size])


def in_mujoco(obstacles, probe, probe_size):
    """A model with the obstacles and a probe geom; returns distances(position, quaternion) -> [M]."""
    spec = mujoco.MjSpec()
    for i in range(len(obstacles.kind)):
        kind = ShapeKind(int(obstacles.kind[i]))
        size = np.asarray(obstacles.half_size[i], float)
        spec.worldbody.add_geom(
            type=MUJOCO_KINDS[kind],
            size=size if kind == ShapeKind.BOX else [size[0], size[2], 0],
            pos=obstacles.centre[i],
            quat=obstacles.quaternion[i],
        )
    body = spec.worldbody.add_body(mocap=True)
    body.add_geom(type=MUJOCO_KINDS[probe], size=probe_size)
    model = spec.compile()
    data = mujoco.MjData(model)

    def distances_at(position, quaternion=(1, 0, 0, 0)):
        data.mocap_pos[0], data.mocap_quat[0] = position, quaternion
        mujoco.mj_forward(model, data)
        last = model.ngeom - 1
        return [mujoco.mj_geomDistance(model, data, i, last, 10, None) for i in range(last)]

    return distances_at


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
    obstacles, point = one_shape(kind, half_size), jnp.array([point], float)
    np.testing.assert_allclose(distance(obstacles, point), [expected], atol=1e-7)
    np.testing.assert_allclose(gradient(obstacles, point), [normal], atol=1e-6)


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
    slope = gradient(obstacles, jnp.asarray(rng.uniform(-0.8, 0.8, (5000, 3)), float))
    np.testing.assert_allclose(jnp.linalg.norm(slope, axis=-1), 1, atol=1e-5)


@both_gradients
@pytest.mark.parametrize("kind", list(ShapeKind))
def test_gradient_is_finite_on_kinks_faces_and_axes(kind, gradient):
    lattice = jnp.stack(jnp.meshgrid(*[jnp.linspace(-0.4, 0.4, 9)] * 3), axis=-1).reshape(-1, 3)
    obstacles = one_shape(
        kind, (0.1, 0.1, 0.2)
    )  # the lattice holds its centre, axis, edges, corners and faces
    slope = gradient(obstacles, lattice)
    assert jnp.all(jnp.linalg.norm(slope, axis=-1) <= 1 + 1e-6)
    outside = distance(obstacles, lattice) > 1e-6
    np.testing.assert_allclose(jnp.linalg.norm(slope[outside], axis=-1), 1, atol=1e-6)
    pose_and_size = (obstacles.centre, obstacles.quaternion, obstacles.half_size)

    def reshaped(pose_and_size):
        changed = eqx.tree_at(lambda o: (o.centre, o.quaternion, o.half_size), obstacles, pose_and_size)
        return signed_distance(changed, lattice)

    assert all(jnp.all(jnp.isfinite(part)) for part in jax.jit(jax.jacfwd(reshaped))(pose_and_size))


@properties
@given(seeds)
def test_moving_everything_together_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    obstacles, points = random_obstacles(rng), rng.uniform(-0.8, 0.8, (50, 3))
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
    obstacles, points = random_obstacles(rng), rng.uniform(-0.8, 0.8, (2, 50, 3))
    points[1] = points[0] + reach * (points[1] - points[0])
    value = np.asarray(distance(obstacles, jnp.asarray(points, float)))
    apart = np.linalg.norm(points[1] - points[0], axis=-1)
    assert np.all(np.abs(value[1] - value[0]) <= apart + 1e-6)


@both_gradients
@properties
@given(seeds)
def test_walking_down_the_gradient_reaches_the_surface(gradient, seed):
    rng = np.random.default_rng(seed)
    obstacles = random_obstacles(rng)
    points = jnp.asarray(rng.uniform(-0.8, 0.8, (50, 3)), float)
    value = distance(obstacles, points)
    surface = points - value[:, None] * gradient(obstacles, points)
    landed = jnp.take_along_axis(distances(obstacles, surface), nearest(obstacles, points)[:, None], axis=1)
    np.testing.assert_allclose(landed, 0, atol=3e-6)


def test_inactive_obstacles_do_not_count():
    obstacles = random_obstacles(np.random.default_rng(4))
    points = jnp.asarray(np.random.default_rng(5).uniform(-0.8, 0.8, (100, 3)), float)
    some = eqx.tree_at(lambda o: o.active, obstacles, jnp.arange(9) % 2 == 0)
    kept = jax.tree.map(lambda field: field[::2], obstacles)
    np.testing.assert_allclose(distance(some, points), distance(kept, points), atol=1e-6)
    np.testing.assert_array_equal(nearest(some, points), 2 * nearest(kept, points))
    assert jnp.all(distances(some, points)[:, 1::2] == FAR)


@both_gradients
def test_no_active_obstacle_is_far_away_and_has_no_gradient(gradient):
    obstacles = random_obstacles(np.random.default_rng(4))
    parked = eqx.tree_at(lambda o: o.active, obstacles, jnp.zeros(9, bool))
    none = jax.tree.map(lambda field: field[:0], obstacles)
    points = jnp.ones((2, 3))
    for empty in (parked, none):
        assert jnp.all(distance(empty, points) == FAR)
        assert jnp.all(segment_distance(empty, points, points + 1) == FAR)
        assert jnp.all(nearest(empty, points) == -1)
        assert jnp.all(gradient(empty, points) == 0)


@both_gradients
def test_nearest_is_the_first_of_the_least_distances_and_nan_stays_nan(gradient):
    rng = np.random.default_rng(4)
    once = random_obstacles(rng)
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), once)  # every obstacle has an equal
    points = jnp.asarray(rng.uniform(-0.9, 0.9, (500, 3)))
    np.testing.assert_array_equal(nearest(twice, points), distances(twice, points).argmin(-1))
    assert nearest(twice, points).max() < len(KINDS)
    assert jnp.isnan(distance(once, jnp.array([[jnp.nan, 0.0, 0.0]])))
    for field in ("centre", "half_size", "quaternion"):
        broken = eqx.tree_at(operator.attrgetter(field), once, replace_fn=lambda old: old.at[4].set(jnp.nan))
        assert (nearest(broken, points) == 4).all()
        assert jnp.isnan(distance(broken, points)).all() and jnp.isnan(gradient(broken, points)).all()


@pytest.mark.parametrize("shape", [(), (1,), (3, 11), (64,)])
def test_the_written_gradient_comes_with_the_same_distance_in_any_shape(shape):
    rng = np.random.default_rng(7)
    obstacles, points = random_obstacles(rng), jnp.asarray(rng.uniform(-0.8, 0.8, (*shape, 3)), float)
    found, *slope = signed_distance_and_gradient(obstacles, *jnp.moveaxis(points, -1, 0))
    np.testing.assert_allclose(found, signed_distance(obstacles, points), atol=1e-7)
    flat = derived(obstacles, points.reshape(-1, 3))
    np.testing.assert_allclose(jnp.stack(slope, axis=-1).reshape(-1, 3), flat, atol=1e-6)


def test_coordinates_of_different_shapes_are_refused_with_and_without_obstacles():
    x, y = jnp.zeros(()), jnp.zeros(3)
    unchecked = inspect.unwrap(signed_distance_and_gradient)  # in tests jaxtyping would refuse them before
    some = random_obstacles(np.random.default_rng(9))
    for obstacles in (some, jax.tree.map(lambda leaf: leaf[:0], some)):
        with pytest.raises(ValueError, match=r"shapes \(\), \(3,\) and \(3,\), expected one shape"):
            unchecked(obstacles, x, y, y)


def test_the_written_gradient_of_many_scenes_at_once_is_that_of_each():
    scenes = [random_obstacles(np.random.default_rng(seed)) for seed in range(3)]
    points = jnp.asarray(np.random.default_rng(3).uniform(-0.8, 0.8, (3, 3, 7)), float)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    together = jax.vmap(lambda scene, point: jnp.stack(signed_distance_and_gradient(scene, *point)))
    each = [jnp.stack(signed_distance_and_gradient(s, *p)) for s, p in zip(scenes, points, strict=True)]
    np.testing.assert_allclose(together(stacked, points), jnp.stack(each), atol=1e-6)


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
        found = signed_distance(fine, points)
        assert found.dtype == jnp.float64
        np.testing.assert_allclose(found, signed_distances(fine, points).min(-1), atol=1e-12)


def test_moving_the_obstacle_is_moving_the_point_back():
    rng = np.random.default_rng(6)
    obstacles, point = random_obstacles(rng), jnp.asarray(rng.uniform(-0.8, 0.8, 3), float)

    def moved(shift):
        return signed_distance(eqx.tree_at(lambda o: o.centre, obstacles, obstacles.centre + shift), point)

    by_point = derived(obstacles, point[None])[0]
    np.testing.assert_allclose(jax.jit(jax.grad(moved))(jnp.zeros(3)), -by_point, atol=1e-6)


def test_vmap_over_scenes_equals_a_loop():
    scenes = [random_obstacles(np.random.default_rng(seed)) for seed in range(3)]
    points = jnp.asarray(np.random.default_rng(7).uniform(-0.8, 0.8, (3, 20, 3)), float)
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


def test_segments_equal_mujoco_capsules_where_they_are_apart():
    rng = np.random.default_rng(8)
    obstacles = random_obstacles(rng)
    radius, half_length = 0.01, 0.15
    centres = rng.uniform(-1, 1, (200, 3))
    turns = Rotation.random(200, rng=rng)
    half = turns.apply([0, 0, half_length])
    ours = segment_distance(obstacles, jnp.asarray(centres - half, float), jnp.asarray(centres + half, float))
    mujoco_distances = in_mujoco(obstacles, ShapeKind.CAPSULE, [radius, half_length, 0])
    theirs = np.array(
        [
            min(mujoco_distances(centre, quaternion))
            for centre, quaternion in zip(centres, turns.as_quat(scalar_first=True), strict=True)
        ]
    )
    apart = theirs > 1e-4
    assert np.count_nonzero(apart) > 80
    np.testing.assert_allclose(ours[apart] - radius, theirs[apart], atol=2e-5)
    assert np.all(ours[theirs < -1e-4] < radius)


@properties
@given(seeds, st.floats(0.01, 2))
def test_segments_find_the_least_of_many_samples(seed, length):
    rng = np.random.default_rng(seed)
    obstacles = random_obstacles(rng)
    start = rng.uniform(-0.8, 0.8, (20, 3))
    direction = rng.normal(size=(20, 3))
    end = start + length * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    fractions = np.linspace(0, 1, 201)[:, None, None]
    samples = distance(obstacles, jnp.asarray(start + fractions * (end - start), float)).min(axis=0)
    found = segment_distance(obstacles, jnp.asarray(start, float), jnp.asarray(end, float))
    assert np.all(found <= samples + 3e-6)
    assert np.all(found >= samples - length / 400 - 3e-6)


def test_a_link_through_a_thin_wall_is_inside_it():
    wall = one_shape(ShapeKind.BOX, (0.0005, 1, 1))
    start, end = jnp.array([-0.0181, 0.2, 0.1]), jnp.array([0.0329, 0.2, 0.1])
    assert distance(wall, jnp.stack([start, end])).min() > 0.017
    np.testing.assert_allclose(segment_distance(wall, start, end), -0.0005, atol=1e-6)


def test_segment_gradient_equals_finite_differences():
    rng = np.random.default_rng(9)
    with jax.enable_x64(True):
        obstacles = random_obstacles(rng)
        ends = jnp.asarray(rng.uniform(-0.8, 0.8, (200, 2, 3)))

        @jax.jit
        def value(ends):
            return segment_signed_distance(obstacles, ends[..., 0, :], ends[..., 1, :])

        slope = jax.grad(lambda ends: value(ends).sum())(ends)
        assert jnp.all(jnp.isfinite(slope))
        step = 1e-5 * jnp.eye(6).reshape(6, 2, 3)
        numeric = (value(ends[:, None] + step) - value(ends[:, None] - step)).reshape(-1, 2, 3) / 2e-5
        outside = value(ends) > 0  # inside, the deepest point mostly lies on a kink
        assert jnp.count_nonzero(outside) > 50
        np.testing.assert_allclose(slope[outside], numeric[outside], atol=1e-4)
