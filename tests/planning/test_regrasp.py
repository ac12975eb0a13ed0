"""Candidates and the rules of a regrasp, by hand-made grasps."""

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.keys import stream
from doojax.planning.regrasp import (
    Strategy,
    alternating_candidates,
    candidates_of,
    geodesic,
    got_stuck,
    points_at,
    sampled_places,
    stays_put,
    strategies_of,
)

STAY, GRASP, MOVE, RELEASE = Strategy
NOTHING = float("nan")


def test_the_valid_strategies_are_those_of_the_released_code():
    assert set(strategies_of([False, False])) == {(STAY, GRASP), (GRASP, STAY)}
    assert set(strategies_of([False, True])) == {(STAY, MOVE), (GRASP, STAY), (GRASP, RELEASE)}
    assert set(strategies_of([True, True])) == {
        (STAY, MOVE),
        (MOVE, STAY),
        (STAY, RELEASE),
        (RELEASE, STAY),
        (MOVE, RELEASE),
        (RELEASE, MOVE),
    }


def test_one_hand_may_only_hold_on_elsewhere():
    assert strategies_of([True]) == [(MOVE,)]
    assert strategies_of([False]) == [(GRASP,)]


@pytest.mark.parametrize("now", [(NOTHING, NOTHING), (NOTHING, 0.4), (0.2, 0.4)])
def test_every_candidate_holds_the_rope_and_changes_something(now):
    found = candidates_of(now, stream(0, "test"), 6, 0.9)
    assert found.holding.any(1).all()
    assert (found.moving.sum(1) <= 1).all()
    held = ~np.isnan(now)
    stays = found.strategies == STAY
    same = np.isclose(found.places, np.array(now), equal_nan=True)
    assert same[stays].all() and not (stays & held).all(1).any()
    assert (np.isnan(found.places) == (found.strategies == RELEASE) | (stays & ~held)).all()


def test_candidates_are_as_many_as_places_and_one_where_nobody_goes_anywhere():
    assert len(candidates_of((NOTHING, NOTHING), stream(0, "test"), 5, 1.0)) == 2 * 5
    assert len(candidates_of((NOTHING, 0.3), stream(0, "test"), 5, 1.0)) == 3 * 5
    assert len(candidates_of((0.7, 0.3), stream(0, "test"), 5, 1.0)) == 4 * 5 + 2
    with pytest.raises(ValueError, match="count is 0"):
        candidates_of((0.1, 0.2), stream(0, "test"), 0, 1.0)


def test_places_begin_with_the_keypoint_and_the_ends():
    assert sampled_places(stream(0, "a"), 5, 0.4)[:3].tolist() == [0.4, 0.0, 1.0]
    assert sampled_places(stream(0, "b"), 5, 1.0)[:2].tolist() == [1.0, 0.0]
    assert sampled_places(stream(0, "c"), 1, 0.4).tolist() == [0.4]
    drawn = sampled_places(stream(0, "d"), 2_000, 0.4)[3:]
    assert drawn.min() >= 0 and drawn.max() <= 1 and abs(drawn.mean() - 0.5) < 0.03


def test_alternating_the_other_hand_grasps_near_the_keypoint_and_the_holder_lets_go():
    found = alternating_candidates((0.93, NOTHING), stream(0, "test"), 200, 1.0)
    assert len(found) == 200 and (found.strategies == [RELEASE, GRASP]).all()
    assert np.isnan(found.places[:, 0]).all() and found.places[0, 1] == 1.0
    drawn = found.places[1:, 1]
    assert drawn.max() <= 1 and abs((1 - drawn).mean() - 0.04 * np.sqrt(2 / np.pi)) < 0.006  # reflected
    assert alternating_candidates((NOTHING, 0.2), stream(0, "test"), 3, 0.15).places[0].tolist()[0] == 0.15
    low = alternating_candidates((NOTHING, 0.2), stream(0, "test"), 50, 0.0).places[:, 0]
    assert low.min() >= 0 and low.max() > 0.02


def test_alternating_either_hand_may_begin_and_one_must_be_free():
    found = alternating_candidates((NOTHING, NOTHING), stream(0, "test"), 3, 0.95)
    assert found.strategies.tolist() == [[GRASP, STAY]] * 3 + [[STAY, GRASP]] * 3
    with pytest.raises(ValueError, match="one must hold nothing"):
        alternating_candidates((0.1, 0.9), stream(0, "test"), 3, 0.95)
    with pytest.raises(ValueError, match="count is 0"):
        alternating_candidates((0.1, NOTHING), stream(0, "test"), 0, 0.95)


def test_going_back_to_the_same_place_changes_nothing():
    found = candidates_of((NOTHING, 0.99), stream(0, "test"), 3, 1.0)
    rows = stays_put(found, (NOTHING, 0.99))
    for row in np.flatnonzero(rows):
        assert found.strategies[row].tolist() == [STAY, MOVE] and found.places[row, 1] == 1.0
    assert rows.sum() == 1


def test_the_geodesic_is_that_of_the_nearest_hand():
    places = np.array([[0.2, 0.7], [NOTHING, 0.1], [NOTHING, NOTHING]])
    np.testing.assert_allclose(geodesic(places, 0.9), [0.2, 0.8, np.inf])


def test_a_signature_is_listed_only_if_no_nearer_grasp_is_found():
    assert not got_stuck((NOTHING, 0.5), (NOTHING, 0.6), 1.0)
    assert got_stuck((NOTHING, 0.5), (NOTHING, 0.52), 1.0)  # as good as the same place
    assert got_stuck((NOTHING, 1.0), (0.0, NOTHING), 1.0)
    assert got_stuck((0.5, 0.9), (0.8, NOTHING), 1.0)  # the nearest hand counts
    assert not got_stuck((NOTHING, NOTHING), (0.1, NOTHING), 1.0)  # nobody held it: nothing was tried


def test_points_of_a_rope():
    rope = jnp.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    for place, expected in ((0.0, [0, 0, 0]), (0.25, [0.5, 0, 0]), (0.75, [1, 0.5, 0]), (1.0, [1, 1, 0])):
        np.testing.assert_allclose(points_at(rope, jnp.asarray(place)), expected, atol=1e-6)
