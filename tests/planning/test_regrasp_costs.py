"""Each term of the cost of a grasp, by numbers worked out by hand."""

import jax.numpy as jnp
import pytest

from doojax.planning import regrasp_costs as costs
from doojax.topology.signatures import Blocklist, Signature

NOTHING = float("nan")


def test_what_cannot_be_done_costs_a_thousand():
    assert costs.infeasible(jnp.array(False)) == 1000
    assert costs.infeasible(jnp.array(True)) == 0


def test_a_signature_that_was_tried_costs_a_hundred():
    tried, other = Signature.of([(1, 0)], 2), Signature.of([(0, 1)], 2)
    listed = Blocklist.empty(4, like=tried).add(tried)
    assert costs.blocklisted(tried, listed) == 100
    assert costs.blocklisted(other, listed) == 0


def test_another_signature_than_the_goal_costs_by_its_distance():
    goal = Signature.of([(1, 0, 0)], 3)
    assert costs.other_signature(goal, goal) == 0
    assert costs.other_signature(Signature.of([(0, 0, 1)], 3), goal) == 200  # one entry less, one more
    # order does not matter, and a loop too many costs one more than its entries
    two, turned = Signature.of([(1, 0, 0), (0, 1, 0)], 3), Signature.of([(0, 1, 0), (1, 0, 0)], 3)
    assert costs.other_signature(two, turned) == 0
    assert costs.other_signature(two, goal) == 200
    with pytest.raises(ValueError, match="cannot be compared"):
        costs.other_signature(Signature.of([(1, 0)], 2), goal)


def test_the_geodesic_term_is_the_sum_of_the_equation_or_the_least_of_the_older_code():
    both, one = jnp.array([0.2, 0.7]), jnp.array([NOTHING, 0.7])
    assert costs.far_from_keypoint(both, 0.9) == pytest.approx(30 * (0.7 + 0.2))
    assert costs.far_from_keypoint(one, 0.9) == pytest.approx(30 * 0.2, rel=1e-5)
    least = costs.RegraspWeights(geodesics="least")
    assert costs.far_from_keypoint(both, 0.9, least) == pytest.approx(30 * 0.2, rel=1e-5)


def test_the_robots_motion_is_the_squares_of_its_steps():
    way = jnp.array([[0.0, 0.0], [3.0, 4.0], [3.0, 0.0]])
    assert costs.robot_motion(way) == pytest.approx(0.01 * (25 + 16))
    assert costs.robot_motion(100 * way) == 50  # no more than that
    assert costs.robot_motion(way[:1]) == 0


def test_the_ropes_motion_is_the_mean_distance_of_its_points():
    before = jnp.zeros((2, 3))
    after = jnp.array([[0.0, 0, 0], [0.3, 0.4, 0]])
    assert costs.rope_motion(before, after) == pytest.approx(6 * 0.25)
    assert costs.rope_motion(before, 100 * after) == 50


def test_a_large_penalty_outweighs_all_that_is_small():
    weights = costs.WEIGHTS
    assert weights.infeasible > weights.blocklist + 2 * weights.geodesic + 2 * weights.most
    assert weights.blocklist > 2 * weights.geodesic
