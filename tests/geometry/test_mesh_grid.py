import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from doojax.geometry import fill_mesh_grid, mesh_signed_distance

interpolate = jax.jit(mesh_signed_distance)


def box_distance(points, half_size):
    excess = np.abs(points) - half_size
    return np.linalg.norm(np.maximum(excess, 0), axis=-1) + np.minimum(excess.max(-1), 0)


def nodes(grid):
    axes = [float(grid.origin[a]) + float(grid.spacing) * np.arange(grid.values.shape[a]) for a in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def test_nodes_hold_the_exact_distance_of_a_box():
    box = trimesh.creation.box((0.2, 0.3, 0.4))
    grid = fill_mesh_grid(box, 0.05, 0.1)
    assert grid.values.shape == (9, 11, 13)
    np.testing.assert_allclose(grid.values, box_distance(nodes(grid), np.array([0.1, 0.15, 0.2])), atol=1e-6)


def test_nodes_around_a_torus_equal_trimesh():
    mesh = trimesh.creation.torus(0.3, 0.1, major_sections=16, minor_sections=8)
    grid = fill_mesh_grid(mesh, 0.08, 0.1)
    points = nodes(grid).reshape(-1, 3)
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, points)
    np.testing.assert_allclose(np.abs(grid.values).reshape(-1), distance, atol=1e-6)
    smooth = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.3, points[:, 2]) - 0.1
    clear = np.abs(smooth) > 0.02  # the facets lie within 1.2 cm of the smooth torus
    np.testing.assert_array_equal(np.sign(grid.values).reshape(-1)[clear], np.sign(smooth)[clear])


def test_faces_wound_inward_change_nothing():
    box = trimesh.creation.box((0.2, 0.3, 0.4))
    outward = fill_mesh_grid(box, 0.1, 0.1)
    box.invert()
    np.testing.assert_array_equal(fill_mesh_grid(box, 0.1, 0.1).values, outward.values)


def test_interpolation_error_keeps_its_bounds():
    half_size, spacing = np.array([0.1, 0.15, 0.2]), 0.02
    grid = fill_mesh_grid(trimesh.creation.box(2 * half_size), spacing, 0.1)
    points = np.random.default_rng(0).uniform(-0.99, 0.99, (5000, 3)) * (half_size + 0.1)
    exact = box_distance(points, half_size)
    error = np.abs(interpolate(grid, jnp.asarray(points, float)) - exact)
    assert error.max() <= np.sqrt(3) / 2 * spacing
    excess = np.abs(points) - half_size
    beside_a_face = (np.sort(excess, axis=-1)[:, 1] < -spacing) & (exact > spacing)
    assert error[beside_a_face].max() < 1e-6
    beside_an_edge = (np.sort(excess, axis=-1)[:, 1] > spacing) & (excess.min(-1) < -spacing)
    radius = exact[beside_an_edge] - spacing * np.sqrt(2)
    assert np.all(error[beside_an_edge] <= spacing**2 / (4 * np.maximum(radius, 1e-3)))


def test_beyond_the_grid_it_is_a_lower_bound_of_the_distance():
    half_size = np.array([0.1, 0.15, 0.2])
    grid = fill_mesh_grid(trimesh.creation.box(2 * half_size), 0.02, 0.05)
    points = np.random.default_rng(1).uniform(-1, 1, (2000, 3))
    exact = box_distance(points, half_size)
    found = np.asarray(interpolate(grid, jnp.asarray(points, float)))
    tolerance = np.sqrt(3) / 2 * 0.02
    outside = exact > 0
    assert np.all(found[outside] <= exact[outside] + tolerance)
    assert np.all(found[outside] >= exact[outside] / np.sqrt(2) - tolerance)


def test_gradient_equals_finite_differences_inside_and_outside_the_grid():
    grid = fill_mesh_grid(trimesh.creation.icosphere(subdivisions=2, radius=0.2), 0.05, 0.1)
    with jax.enable_x64(True):
        grid = jax.tree.map(lambda leaf: leaf.astype(float), grid)
        points = jnp.asarray(np.random.default_rng(2).uniform(-0.6, 0.6, (500, 3)))
        slope = jax.jit(jax.vmap(jax.grad(mesh_signed_distance, argnums=1), (None, 0)))(grid, points)
        step = 1e-7 * jnp.eye(3)
        ahead, behind = (interpolate(grid, points[:, None] + s) for s in (step, -step))
        np.testing.assert_allclose(slope, (ahead - behind) / 2e-7, atol=1e-5)
        near = jnp.abs(jnp.linalg.norm(points, axis=-1) - 0.2) < 0.05
        np.testing.assert_allclose(jnp.linalg.norm(slope[near], axis=-1), 1, atol=0.15)


def test_open_mesh_is_refused():
    box = trimesh.creation.box((1, 1, 1))
    box.update_faces(np.arange(12) > 0)
    with pytest.raises(ValueError, match=r"not watertight: 3 of its 18 edges do not join two faces"):
        fill_mesh_grid(box, 0.1, 0.1)


def test_inconsistent_winding_is_refused():
    box = trimesh.creation.box((1, 1, 1))
    box.faces[0] = box.faces[0][::-1]
    with pytest.raises(ValueError, match=r"wound inconsistently.*fix_winding"):
        fill_mesh_grid(box, 0.1, 0.1)


@pytest.mark.parametrize("spacing, padding", [(0.0, 0.1), (-1.0, 0.1), (0.1, -0.1), (float("nan"), 0.1)])
def test_bad_spacing_and_padding_are_refused(spacing, padding):
    with pytest.raises(ValueError, match=f"spacing {spacing} and padding {padding}"):
        fill_mesh_grid(trimesh.creation.box((1, 1, 1)), spacing, padding)


def test_a_mesh_in_millimetres_is_refused():
    with pytest.raises(ValueError, match=r"grid of 30003 x 30003 x 30003 nodes .* is in metres"):
        fill_mesh_grid(trimesh.creation.box((300, 300, 300)), 0.01, 0.01)
