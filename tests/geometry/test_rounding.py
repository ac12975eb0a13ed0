"""Coordinates far from the origin keep their digits, or are refused with advice that works."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from doojax.geometry import fill_mesh_grid, grid_covering, mesh_signed_distance
from doojax.geometry.rounding import LostDigits, require_digits, rounding

FAR = np.array([388096.0, 3948996.0, 40.0])  # metres, in a map's grid


def test_rounding_is_at_least_the_spacing_of_floating_point_numbers():
    for largest in (0.3, 1.0, 1023.0, 3948996.0):
        spacing = np.spacing(np.float32(largest))
        assert spacing <= rounding(np.array([[0.0, -largest, 0.1]])) <= 2 * spacing
    assert rounding(FAR, own=True) == pytest.approx(FAR.max() * 2**-52)
    assert rounding(FAR.astype(int), own=True) == 0


def test_what_would_lose_its_digits_is_refused_and_subtracting_helps():
    points = FAR + np.eye(3)
    with pytest.raises(
        LostDigits, match=r"a rope are up to 3948997 m, which float32 rounds to 0.5 m; .*: do"
    ):
        require_digits("a rope", "do this", points)
    require_digits("a rope", "do this", points - FAR)
    require_digits("nothing", "do this")


def test_a_mesh_in_map_coordinates_has_the_distances_of_the_same_mesh_at_the_origin():
    near = trimesh.creation.torus(0.1, 0.03, major_sections=12, minor_sections=6)
    far = near.copy()
    far.apply_translation(FAR)
    grids = [fill_mesh_grid(mesh, 0.02, 0.06) for mesh in (near, far)]
    np.testing.assert_allclose(grids[1].values, grids[0].values, atol=1e-7)
    assert float(grids[1].values.min()) < -0.015
    origin, remainder = (np.asarray(part, np.float64) for part in (grids[1].origin, grids[1].remainder))
    np.testing.assert_allclose(origin + remainder, far.bounds[0] - 0.06, atol=1e-8)


def test_distances_to_a_mesh_are_nan_where_points_have_lost_their_digits():
    box = trimesh.creation.box((20.0, 20.0, 20.0))
    box.apply_translation(FAR)
    grid = fill_mesh_grid(box, 2.0, 4.0)
    exact = jnp.array([[388096.0, 3948996.0, 40.0], [388096.0, 3948996.0, 54.0]])  # half metres are kept
    np.testing.assert_allclose(mesh_signed_distance(grid, exact), [-10.0, 4.0], atol=1e-5)
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    grid = fill_mesh_grid(box, 0.05, 0.1)
    near, beyond = jnp.array([0.0, 0.0, 0.05]), jnp.array([0.0, 0.0, 4e6])
    assert mesh_signed_distance(grid, near) == pytest.approx(-0.05, abs=1e-6)
    assert mesh_signed_distance(grid, beyond) == pytest.approx(4e6, rel=1e-3)  # what was lost matters not
    box.apply_translation(FAR)
    assert jnp.isnan(mesh_signed_distance(fill_mesh_grid(box, 0.05, 0.1), jnp.asarray(FAR)))


def test_a_grid_in_map_coordinates_is_refused():
    with pytest.raises(ValueError, match=r"of a grid are up to 3948997 m.*subtract a common origin"):
        grid_covering(tuple(FAR), tuple(FAR + 1), 0.1)
    assert grid_covering((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.1).shape == (10, 10, 10)
