"""Under ``jax.numpy_rank_promotion("raise")``, where broadcasting must be said, all of geometry passes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from doojax import geometry as g
from doojax.types import Obstacles

OBSTACLES = Obstacles(
    jnp.arange(3),
    jnp.ones((3, 3)),
    jnp.tile(jnp.array([1.0, 0, 0, 0]), (3, 1)),
    jnp.ones((3, 3)),
    jnp.ones(3, bool),
)
GRID = g.Grid(jnp.zeros(3), 0.1, (4, 5, 6))
MESH_GRID = g.MeshGrid(jnp.ones((4, 5, 6)), jnp.zeros(3), jnp.zeros(3), jnp.array(0.1))
POINT, LINE, MANY = jnp.ones(3), jnp.ones((7, 3)), jnp.ones((2, 7, 3))
TURN, TURNS = jnp.ones(4), jnp.ones((7, 4))


def slope(function, *arguments):
    return jax.grad(lambda *given: function(*given).sum(), argnums=len(arguments) - 1, allow_int=True)(
        *arguments
    )


CASES = {
    "curves": lambda: (
        g.arc_lengths(LINE),
        g.resample(LINE, 5),
        g.turning_angles(LINE),
        g.curvatures(LINE),
        g.catenary(POINT, 2 * POINT, 3.0, 9),
    ),
    "rotations": lambda: [
        function(turn, vector)
        for function in (g.rotate, g.rotate_inverse)
        for turn, vector in ((TURN, MANY), (TURNS, POINT), (TURNS, MANY))
    ],
    "quaternions": lambda: (
        [g.quaternion_multiply(*pair) for pair in ((TURN, TURNS), (TURNS, TURN), (TURNS, TURNS))],
        [function(TURNS) for function in (g.quaternion_inverse, g.quaternion_yaw, g.quaternion_to_matrix)],
        g.quaternion_from_yaw(TURN),
    ),
    "frames": lambda: [
        function(position, turn, points)
        for function in (g.to_body, g.to_world)
        for position, turn, points in ((POINT, TURN, MANY), (LINE, TURNS, POINT), (POINT, TURN, POINT))
    ],
    "meshes": lambda: [g.mesh_signed_distance(MESH_GRID, points) for points in (POINT, LINE, MANY)],
    "distances": lambda: [
        function(OBSTACLES, points)
        for function in (g.signed_distance, g.signed_distances, g.nearest_obstacle)
        for points in (POINT, LINE, MANY)
    ],
    "segments": lambda: (
        [g.segment_signed_distance(OBSTACLES, points, 2 * points) for points in (POINT, MANY)]
        + [g.segment_distance(points, 2 * points, -points, 3 * points) for points in (POINT, MANY)]
    ),
    "gradients": lambda: (
        g.signed_distance_and_gradient(OBSTACLES, *(MANY[..., axis] for axis in range(3))),
        slope(g.signed_distance, OBSTACLES, MANY),
        slope(g.mesh_signed_distance, MESH_GRID, MANY),
        slope(g.segment_signed_distance, OBSTACLES, LINE, 2 * LINE),
        eqx.filter_grad(lambda obstacles: g.signed_distance(obstacles, MANY).sum())(OBSTACLES),
    ),
    "voxels": lambda: (
        g.crop(GRID, POINT, (3, 3, 3)).centres(),
        g.occupancy(OBSTACLES, GRID),
        g.gaussian_raster(LINE, GRID),
        g.inverse_log_raster(LINE, GRID),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_broadcasting_is_said(name):
    with jax.numpy_rank_promotion("raise"):
        eqx.filter_eval_shape(CASES[name])
