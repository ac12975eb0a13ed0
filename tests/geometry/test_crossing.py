"""Segments that enter obstacles, beside the signed distance at many points along each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.geometry import enters, signed_distance
from doojax.types import Obstacles, ShapeKind


def one(kind, half_size, centre=(0.0, 0.0, 0.0), quaternion=(1.0, 0.0, 0.0, 0.0), active=True) -> Obstacles:
    return Obstacles(
        kind=jnp.array([int(kind)]),
        centre=jnp.array([centre]),
        quaternion=jnp.array([quaternion]),
        half_size=jnp.array([half_size]),
        active=jnp.array([active]),
    )


@pytest.mark.parametrize("kind", list(ShapeKind))
def test_what_enters_is_what_has_a_point_inside(kind):
    rng = np.random.default_rng(int(kind))
    quaternion = rng.normal(size=4)
    size = (0.1, 0.1 if kind != ShapeKind.BOX else 0.2, 0.3)
    obstacle = one(kind, size, (0.3, -0.2, 0.1), tuple(quaternion / np.linalg.norm(quaternion)))
    start, end = (jnp.asarray(rng.uniform(-0.6, 0.9, (4000, 3)), dtype=jnp.float32) for _ in range(2))
    ways = start[:, None] + jnp.linspace(0, 1, 2001)[:, None] * (end - start)[:, None]
    nearest = signed_distance(obstacle, ways).min(1)
    sure = jnp.abs(nearest) > 1e-3  # what only grazes, points at equal intervals may miss
    found = enters(obstacle, start, end)
    assert 0.05 < found.mean() < 0.6
    assert bool(jnp.array_equal(found[sure], nearest[sure] < 0))


@pytest.mark.parametrize("kind", list(ShapeKind))
def test_points_that_stand_still_enter_where_they_are_inside(kind):
    obstacle = one(kind, (0.1, 0.1, 0.3))
    points = jnp.array([[0.0, 0.0, 0.0], [0.09, 0.0, 0.0], [0.11, 0.0, 0.0], [0.0, 0.0, 0.45]])
    assert enters(obstacle, points, points).tolist() == [True, True, False, False]


def test_a_thin_plate_is_crossed_between_two_points_outside():
    plate = one(ShapeKind.BOX, (0.5, 0.5, 0.001))
    above, below = jnp.array([0.1, 0.0, 0.004]), jnp.array([0.1, 0.0, -0.004])
    assert bool(enters(plate, above, below))
    assert not bool(enters(plate, above, above + jnp.array([0.2, 0.0, 0.0])))
    assert not bool(enters(one(ShapeKind.BOX, (0.5, 0.5, 0.001), active=False), above, below))
    assert not bool(enters(plate, above * jnp.nan, below))


def test_no_obstacles_are_entered_by_nothing():
    none = jax.tree.map(lambda leaf: leaf[:0], one(ShapeKind.BOX, (1.0, 1.0, 1.0)))
    assert not enters(none, jnp.zeros((2, 3)), jnp.ones((2, 3))).any()
