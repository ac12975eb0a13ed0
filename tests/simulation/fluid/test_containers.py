"""What is in a container, tilted or not, and how much fits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.geometry.sdf import signed_distance
from doojax.simulation.fluid import Container, FluidSettings, boxes_of, filled, inside

CUP = Container(0.1, 0.08, 0.12)
SPACE = FluidSettings(spacing=0.0132)
FLAT = FluidSettings(spacing=0.01, dimensions=2)
held = jax.jit(inside, static_argnums=0)


@pytest.mark.parametrize("settings", [SPACE, FLAT])
def test_what_is_filled_in_is_inside_and_apart(settings):
    count = CUP.room(settings)
    place = jnp.asarray(filled(CUP, (0.3, 0.0, 0.2), count, settings))
    middle = jnp.array([0.3, 0.0, 0.2])
    assert bool(held(CUP, middle, jnp.zeros(()), place).all())
    gaps = np.linalg.norm(place[:, None] - place[None], axis=-1) + np.eye(count)
    assert gaps.min() > 0.999 * settings.spacing
    edge = np.abs(np.asarray(place) - np.asarray(middle)[[0, -1] if settings.dimensions == 2 else [0, 1, 2]])
    assert edge[:, 0].max() < CUP.width / 2 - 0.999 * settings.radius


def test_of_a_container_on_its_side_the_room_lies_beside_it():
    """Turned by 90 degrees towards +x, its opening looks to +x: what was above it is right of it."""
    x_and_z = [[0.06, 0.0], [0.0, 0.06], [0.115, 0.045], [0.125, 0.0], [-0.01, 0.0]]
    points = jnp.array([[x, 0.0, z] for x, z in x_and_z])
    found = held(CUP, jnp.zeros(3), jnp.array(np.pi / 2), points)
    assert found.tolist() == [True, False, True, False, False]


def test_the_walls_stand_around_the_room():
    rng = np.random.default_rng(0)
    points = jnp.asarray(rng.uniform(-0.15, 0.15, (4000, 3)), jnp.float32)
    middle, angle = jnp.array([0.02, 0.01, -0.03]), jnp.array(0.7)
    walls = boxes_of(CUP, middle, angle)
    within = held(CUP, middle, angle, points)
    assert 0.01 < within.mean() < 0.1
    depth = signed_distance(walls, points)
    assert float(depth[within].min()) >= -1e-6  # no wall stands in the room
    around = held(Container(0.1398, 0.1198, 0.12), middle, angle, points) & ~within
    assert around.any() and float(depth[around].max()) < 0  # and beside it, nothing but walls


@pytest.mark.parametrize(
    ("container", "count", "said"),
    [
        (CUP, 10_000, r"10000 particles of 0\.0132 m do not fit .* expected at most 378"),
        (CUP, 0, "expected at least 1: it would be empty"),
        (Container(0.01, 0.1, 0.1), 5, r"smaller than a particle of 0\.0132 m"),
    ],
)
def test_what_does_not_fit_is_refused(container, count, said):
    with pytest.raises(ValueError, match=said):
        filled(container, (0.0, 0.0, 0.0), count, SPACE)


def test_a_container_has_sides():
    with pytest.raises(ValueError, match=r"height is -0\.1, expected a positive length"):
        Container(0.1, 0.1, -0.1)
