"""Examples that cannot be augmented, and bounds that make no sense."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.augmentation import Bounds, Examples, RopeSetting, augment
from doojax.augmentation.ropes import moving_points, upright
from doojax.geometry.sdf import signed_distance
from doojax.keys import numbered, stream
from doojax.tasks import make_task
from doojax.types import Obstacles, RopeState, ShapeKind, Verdict

TOY = make_task("toy")
SETTING = RopeSetting.of(TOY)


def examples():
    """A rope that goes 5 cm along x, five times, and a parked wall."""
    x = jnp.linspace(-0.2, 0.0, 5)
    rope = jnp.stack([x, jnp.zeros(5), jnp.full(5, 0.05)], -1)
    step = jnp.array([0.05, 0.0, 0.0])
    points = jnp.stack([rope, rope + step])
    states = RopeState(points, points[:, -1:])
    wall = Obstacles(
        kind=jnp.array([ShapeKind.BOX]),
        centre=jnp.array([[0.0, 0.0, 9.0]]),
        quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
        half_size=jnp.array([[0.1, 0.1, 0.1]]),
        active=jnp.array([False]),
    )
    one = (states, step[None, None], wall, jnp.array(True))
    return Examples(*jax.tree.map(lambda leaf: jnp.stack([leaf] * 5), one))


def test_refusals_are_counted_and_hold_no_values():
    given = examples()
    points, grippers = np.array(given.states.points), np.array(given.states.grippers)
    points[1, 1], grippers[1, 1] = points[1, 0], grippers[1, 0]  # nothing moves
    points[2] += [0.6, 0.0, 0.0]  # out of the box
    points[3, 1, 2, 0] = np.nan
    sound = jnp.array([True, True, True, True, False])
    states = RopeState(jnp.array(points), jnp.array(grippers))
    given = Examples(states, given.actions, given.obstacles, sound)
    found = augment(numbered(stream(0, "test"), range(5)), given, SETTING)
    reasons = [Verdict.ACCEPTED, Verdict.NOTHING_MOVED, Verdict.OUTSIDE, Verdict.FAULTY, Verdict.FAULTY]
    assert found.verdict.tolist() == reasons
    assert np.isnan(found.states.points[1:]).all() and np.isfinite(found.states.points[0]).all()
    np.testing.assert_allclose(found.transform[0], found.target[0], atol=1e-6)  # nothing is in the way


def test_moving_points_are_rope_ends_middles_grippers_and_looks_between():
    states = jax.tree.map(lambda leaf: leaf[0], examples().states)
    points, radii = moving_points(SETTING, states, between=1)
    assert points.shape == ((5 + 4 + 2 + 1) * 3, 3) and radii.shape == points.shape[:1]
    x = np.asarray(points[:, 0]).reshape(3, -1)
    assert (x[0].min(), x[0].max()) == (pytest.approx(-0.225), pytest.approx(0.025))
    np.testing.assert_allclose(x[2], (x[0] + x[1]) / 2, atol=1e-7)


def test_out_of_an_upright_box_the_way_is_sideways():
    box = Obstacles(
        kind=jnp.array([ShapeKind.BOX]),
        centre=jnp.array([[0.0, 0.0, 0.1]]),
        quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
        half_size=jnp.array([[0.1, 0.1, 0.1]]),
        active=jnp.array([True]),
    )
    at = jnp.array([0.05, 0.0, 0.02])
    assert float(signed_distance(box, at)) == pytest.approx(-0.02)
    assert float(signed_distance(upright(box), at)) == pytest.approx(-0.05)


@pytest.mark.parametrize(
    ("translation", "rotation", "message"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "the range of transforms is zero: nothing would move"),
        ((-0.1, 0.0, 0.0), (0.0, 0.0, 0.0), "expected numbers of at least 0"),
        ((float("nan"), 0.0, 0.0), (0.0, 0.0, 0.0), "expected numbers of at least 0"),
        ((0.1, 0.0, 0.0), (0.0, 0.0, 4.0), "at most pi"),
    ],
)
def test_bounds_that_make_no_sense(translation, rotation, message):
    with pytest.raises(ValueError, match=message):
        Bounds(translation, rotation)
