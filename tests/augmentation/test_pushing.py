"""Pushed cylinders: who moves, what stays, and that what is accepted is what the simulator does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.augmentation import Examples, augment, setting_of, usual
from doojax.augmentation.examples import transformed
from doojax.augmentation.objectives import Weights
from doojax.keys import generator, numbered, stream
from doojax.tasks import make_task
from doojax.types import PushingState, Verdict

TASK = make_task("planar_pushing")
BOUNDS, PROJECTION = usual(TASK)
SETTING = setting_of(TASK, BOUNDS)
STATES, COUNT, WIDTH = 4, 24, 0.04


def states(places) -> PushingState:
    """Of places [T+1, 10, 2], the hand last."""
    places = jnp.asarray(np.concatenate([places, np.full((*places.shape[:2], 1), 0.02)], -1), jnp.float32)
    return PushingState(places[:, :-1], jnp.zeros_like(places[:, :-1]), places[:, -1])


def pushed() -> PushingState:
    """The hand pushes cylinder 0 along x by 9 mm; the others stand in a row far from it."""
    row = np.stack([np.linspace(-0.16, 0.16, 8), np.full(8, 0.1)], -1)
    first = np.concatenate([[[0.0, 0.0]], row, [[-WIDTH, 0.0]]])
    way = np.zeros((STATES, 10, 2))
    way[:, [0, 9], 0] = 0.003 * np.arange(STATES)[:, None]
    return states(first + way)


def examples(count: int) -> Examples:
    one = pushed()
    actions = jnp.asarray([[[0.003, 0.0, 0.0]]] * (STATES - 1))
    repeat = jax.tree.map(lambda leaf: jnp.stack([leaf] * count), (one, actions))
    return Examples(*repeat, None, jnp.ones(count, dtype=bool))


def test_what_moves_and_what_stays():
    one = pushed()
    assert SETTING.moving(one).tolist() == [True] + [False] * 8
    points, radii, stays, way, some = SETTING.movable(one, None)
    assert some is not None and len(some) < len(points) and some[0] == 0  # what the descent looks at
    assert stays.active.tolist() == [False] + [True] * 8
    assert float(way) == pytest.approx(0.009, abs=1e-6) and set(np.asarray(radii).tolist()) == {
        float(radii[0])
    }
    seen = {tuple(point) for point in np.asarray(points)[:, :2].round(4).tolist()}
    both = np.concatenate([np.asarray(one.positions)[:, 0, :2], np.asarray(one.hand)[:, :2]])
    assert seen == {tuple(point) for point in both.round(4).tolist()}


@pytest.mark.parametrize("weights", [Weights(), pytest.param(Weights(occupancy=0.0), marks=pytest.mark.slow)])
def test_accepted_ones_are_pushed_alike_among_cylinders_that_stand_where_they_stood(weights):
    keys = numbered(stream(0, "test"), range(COUNT))
    found = augment(keys, examples(COUNT), SETTING, PROJECTION, weights)
    accepted = np.flatnonzero(np.asarray(found.verdict) == Verdict.ACCEPTED)
    assert len(accepted) > COUNT / 4  # without a gradient the check still holds
    before = pushed()
    for index in accepted:
        after = jax.tree.map(lambda leaf, i=index: leaf[i], found.states)
        np.testing.assert_array_equal(after.positions[:, 1:], before.positions[:, 1:])
        gap = jnp.linalg.norm(after.positions[:, 0] - after.hand, axis=-1)
        np.testing.assert_allclose(gap, WIDTH, atol=1e-6)
        np.testing.assert_allclose(after.hand[1:] - after.hand[:-1], found.actions[index][:, 0], atol=1e-6)
        moving = jnp.stack([after.positions[:, 0], after.hand], 1)[:, :, None]
        apart = jnp.linalg.norm(moving - after.positions[:, None, 1:], axis=-1)
        assert float(apart.min()) > WIDTH  # nothing was touched that was not
    rejected = np.asarray(found.verdict) != Verdict.ACCEPTED
    assert np.isnan(np.asarray(found.states.positions)[rejected]).all()


def test_random_transforms_do_push_into_what_stands_there():
    targets = jnp.asarray(generator(0, "targets").uniform(-1, 1, (64, 6)), jnp.float32) * SETTING.bounds
    there, _ = transformed(examples(64), SETTING, targets)
    moving = jnp.stack([there.positions[:, :, 0], there.hand], 2)[:, :, :, None]
    apart = jnp.linalg.norm(moving - there.positions[:, :, None, 1:], axis=-1)
    assert int((apart.min((1, 2, 3)) < WIDTH).sum()) > 5


def test_a_hand_that_rests_is_refused():
    given = examples(2)
    still = jax.tree.map(lambda leaf: jnp.repeat(leaf[:, :1], STATES, axis=1), given.states)
    found = augment(
        numbered(stream(0, "test"), range(2)),
        Examples(still, jnp.zeros_like(given.actions), None, given.sound),
        SETTING,
        PROJECTION,
    )
    assert found.verdict.tolist() == [Verdict.NOTHING_MOVED] * 2
