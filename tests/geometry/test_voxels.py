import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from doojax.geometry import (
    Grid,
    crop,
    gaussian_raster,
    grid_covering,
    inverse_log_raster,
    occupancy,
)
from doojax.types import Obstacles, ShapeKind

properties = settings(max_examples=20, deadline=None)
seeds = st.integers(0, 2**32 - 1)
occupied = jax.jit(occupancy)
gaussian = jax.jit(gaussian_raster)


def boxes(centre, quaternion, half_size):
    count = len(centre)
    return Obstacles(
        kind=jnp.full(count, ShapeKind.BOX.value),
        centre=jnp.asarray(centre, float),
        quaternion=jnp.asarray(quaternion, float),
        half_size=jnp.asarray(half_size, float),
        active=jnp.ones(count, bool),
    )


def test_grid_covering_the_dragging_scene():
    grid = grid_covering((-1.25, -1.25, 0.0), (1.25, 1.25, 0.04), 0.01)
    assert grid.shape == (250, 250, 4)
    x, _, z = grid.axes()
    np.testing.assert_allclose([x[0], x[-1], z[0], z[-1]], [-1.245, 1.245, 0.005, 0.035], atol=1e-6)
    centres = grid.centres()
    assert centres.shape == (250, 250, 4, 3)
    np.testing.assert_allclose(centres[7, 30, 2], [-1.175, -0.945, 0.025], atol=1e-6)


def test_occupancy_of_a_box_reaches_half_a_diagonal_beyond_it():
    grid = grid_covering((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1)
    box = boxes([[0, 0, 0]], [[1, 0, 0, 0]], [[0.32, 0.5, 0.21]])
    excess = np.abs(grid.centres()) - np.array([0.32, 0.5, 0.21])
    outside = np.linalg.norm(np.maximum(excess, 0), axis=-1)
    np.testing.assert_array_equal(occupied(box, grid), outside <= 0.05 * np.sqrt(3))
    parked = eqx.tree_at(lambda o: o.active, box, jnp.zeros(1, bool))
    assert not occupied(parked, grid).any()


@properties
@given(seeds)
def test_occupancy_misses_no_part_of_a_needle(seed):
    rng = np.random.default_rng(seed)
    grid = grid_covering((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 0.1)
    turn, centre = Rotation.random(rng=rng), rng.uniform(-0.2, 0.2, 3)
    needle = boxes([centre], [turn.as_quat(scalar_first=True)], [[1e-4, 1e-4, 0.25]])
    along = turn.apply(np.linspace(-0.25, 0.25, 200)[:, None] * [0, 0, 1]) + centre
    voxels = np.floor((along + 0.5) / 0.1).astype(int)
    marked = np.asarray(occupied(needle, grid))
    assert marked[tuple(voxels.T)].all()
    assert np.count_nonzero(marked) < 60


@properties
@given(seeds, st.sampled_from([(10, 10, 4), (9, 10, 3)]))
def test_a_crop_is_a_slice_of_the_grid_and_goes_on_outside_it(seed, shape):
    rng = np.random.default_rng(seed)
    grid = grid_covering((-0.5, -0.5, 0.0), (0.5, 0.5, 0.3), 0.05)
    scene = boxes(
        rng.uniform(-0.6, 0.6, (4, 3)),
        Rotation.random(4, rng=rng).as_quat(scalar_first=True),
        [[0.1] * 3] * 4,
    )
    centre = rng.uniform(-0.6, 0.6, 3)
    local = crop(grid, jnp.asarray(centre, float), shape)
    middle = np.asarray(local.origin) + 0.05 * np.array(shape) / 2
    assert np.all(np.abs(middle - centre) <= 0.025 + 1e-6)

    steps = (np.asarray(local.origin) - np.asarray(grid.origin)) / 0.05
    first = np.round(steps).astype(int)
    np.testing.assert_allclose(steps, first, atol=1e-4)
    wide = Grid(grid.origin - 20 * 0.05, 0.05, (60, 60, 46))  # the same lattice, further
    low = first + 20
    part = np.asarray(occupied(scene, wide))[tuple(slice(a, a + n) for a, n in zip(low, shape, strict=True))]
    assert np.count_nonzero(part != np.asarray(occupied(scene, local))) <= 1  # rounding at the threshold


def test_moving_a_crop_compiles_nothing_new():
    @jax.jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def local_raster(centre, points):
        grid = crop(grid_covering((-1.0, -1.0, 0.0), (1.0, 1.0, 0.04), 0.02), centre, (10, 10, 2))
        return gaussian_raster(points, grid)

    for x in np.linspace(-1, 1, 4):
        local_raster(jnp.array([x, 0.3, 0.0]), jnp.ones((5, 3)) * x)


def test_gaussian_raster_equals_its_formula():
    rng = np.random.default_rng(0)
    grid = grid_covering((0.0, 0.0, 0.0), (0.2, 0.3, 0.1), 0.02)
    points = rng.uniform(0, 0.3, (7, 3))
    squared = ((np.asarray(grid.centres())[..., None, :] - points) ** 2).sum(-1)
    expected = np.exp(-2000 * squared).max(-1)
    np.testing.assert_allclose(gaussian(jnp.asarray(points, float), grid), expected, atol=1e-5)
    assert gaussian(jnp.asarray(points, float), grid, 500.0).sum() > expected.sum()


def test_gaussian_raster_halves_at_19_millimetres():
    grid = Grid(jnp.full(3, -0.005), 0.01, (4, 1, 1))
    radius = np.sqrt(np.log(2) / 2000)
    assert radius == pytest.approx(0.0186, abs=1e-4)
    raster = gaussian(jnp.array([[0.02 - radius, 0, 0]]), grid)
    np.testing.assert_allclose(raster[2, 0, 0], 0.5, atol=1e-5)


def test_inverse_log_raster_is_one_at_the_points_and_falls_slowly():
    grid = Grid(jnp.full(3, -0.005), 0.01, (4, 1, 1))
    raster = inverse_log_raster(jnp.zeros((1, 3)), grid)
    np.testing.assert_allclose(raster[:, 0, 0], 1 / (1 + np.log([1, 2, 3, 4])), rtol=1e-5)


@pytest.mark.parametrize("raster", [gaussian_raster, inverse_log_raster])
def test_raster_gradients(raster):
    with jax.enable_x64(True):
        grid = grid_covering((0.0, 0.0, 0.0), (0.1, 0.1, 0.1), 0.02)
        points = jnp.asarray(np.random.default_rng(1).uniform(0, 0.1, (3, 3)))
        step = jnp.asarray(np.random.default_rng(2).normal(size=(3, 3)))
        image = jax.jit(lambda p: raster(p, grid))
        moved = jax.jit(lambda p, s: jax.jvp(image, (p,), (s,))[1])
        numeric = (image(points + 1e-7 * step) - image(points - 1e-7 * step)) / 2e-7
        np.testing.assert_allclose(moved(points, step), numeric, atol=1e-4)
        on_centres = grid.centres()[1, 1, :3]
        assert jnp.all(jnp.isfinite(moved(on_centres, step)))


def test_grids_without_volume_are_refused():
    with pytest.raises(ValueError, match=r"resolution is 0.0, expected a positive"):
        Grid(jnp.zeros(3), 0.0, (1, 1, 1))
    with pytest.raises(ValueError, match=r"shape is \(4, 0, 4\), expected at least one voxel"):
        Grid(jnp.zeros(3), 0.1, (4, 0, 4))
    with pytest.raises(ValueError, match=r"resolution is -0.1, expected a positive"):
        grid_covering((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), -0.1)
    with pytest.raises(ValueError, match=r"shape is \(10, -10, 10\)"):
        grid_covering((0.0, 0.0, 0.0), (1.0, -1.0, 1.0), 0.1)
