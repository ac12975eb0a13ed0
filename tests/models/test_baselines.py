"""Baselines that learn nothing, on scenes drawn by hand."""

import jax.numpy as jnp
import pytest

from doojax.models import Always, CollisionChecker, Reliability
from doojax.models.protocols import accepts
from doojax.types import Obstacles, RopeState


def wall(half_thickness=0.01, active=True):
    """A thin wall across the x axis at x = 0.1 m."""
    return Obstacles(
        kind=jnp.zeros(1, jnp.int32),
        centre=jnp.array([[0.1, 0.0, 0.0]]),
        quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
        half_size=jnp.array([[half_thickness, 1.0, 1.0]]),
        active=jnp.array([active]),
    )


def rope(*xs):
    points = jnp.array([[x, 0.0, 0.0] for x in xs])
    return RopeState(points=points, grippers=points[-1:])


def judge(reliability, next_state, obstacles=None):
    start = rope(-0.3, -0.2)
    return reliability(
        wall() if obstacles is None else obstacles, start, jnp.zeros((1, 3)), next_state, jnp.zeros(())
    )


def test_always_accepts_whatever_is_predicted():
    nonsense = rope(0.1, jnp.nan)
    assert accepts(Always(), wall(), rope(0.0), jnp.zeros((1, 3)), nonsense, jnp.array(jnp.inf))


def test_the_collision_checker_scores_the_distance_to_the_nearest_obstacle():
    # the wall's near face is at x = 0.09 and the rope ends 4 cm before it
    assert judge(CollisionChecker(), rope(0.0, 0.05)) == pytest.approx(0.04, abs=1e-6)
    assert judge(CollisionChecker(), rope(0.0, 0.05)) > CollisionChecker().threshold
    assert not judge(CollisionChecker(), rope(0.0, 0.075)) > CollisionChecker().threshold


def test_a_link_does_not_slip_through_a_wall_thinner_than_its_length():
    through = rope(0.05, 0.15)  # both points are 4 cm from the wall, which lies between them
    assert judge(CollisionChecker(), through) == pytest.approx(-0.01, abs=1e-6)
    assert judge(CollisionChecker(points_only=True), through) == pytest.approx(0.04, abs=1e-6)


def post(x, y):
    """A post of 4 cm across, upright."""
    return Obstacles(
        kind=jnp.zeros(1, jnp.int32),
        centre=jnp.array([[x, y, 0.0]]),
        quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
        half_size=jnp.array([[0.02, 0.02, 1.0]]),
        active=jnp.array([True]),
    )


def moved(xs, y):
    """A straight rope at some y whose gripper is 5 cm beyond its last point."""
    points = jnp.array([[x, y, 0.0] for x in xs])
    return RopeState(points=points, grippers=points[-1:] + jnp.array([0.05, 0.0, 0.0]))


def test_a_motion_that_cuts_a_corner_with_both_ends_clear_is_noticed():
    # across a post: before and after it every link is 8 cm from its middle, so 6 cm from its face
    before, after = moved((0.0, 0.05), -0.08), moved((0.0, 0.05), 0.08)
    score = CollisionChecker()(post(0.0, 0.0), before, jnp.zeros((1, 3)), after, jnp.zeros(()))
    assert score == pytest.approx(-0.02, abs=1e-5)  # the first point goes through the middle
    blind = CollisionChecker(points_only=True)
    assert blind(post(0.0, 0.0), before, jnp.zeros((1, 3)), after, jnp.zeros(())) == pytest.approx(0.06)


def test_the_gripper_is_looked_at_too():
    # the post stands where only the gripper passes, and then where only the gripper ends
    before = moved((0.0, 0.05), -0.08)
    for y, expected in ((0.08, -0.02), (0.01, -0.02)):
        after = moved((0.0, 0.05), y)
        score = CollisionChecker()(post(0.11, 0.0), before, jnp.zeros((1, 3)), after, jnp.zeros(()))
        assert score == pytest.approx(expected, abs=0.011) and score < 0


def test_a_rope_that_touches_something_may_leave_it_but_not_go_on():
    checker, touching = CollisionChecker(), moved((0.0, 0.05), -0.03)  # 1 cm from the post's face
    for y, allowed in ((-0.06, True), (-0.025, False)):
        score = checker(post(0.0, 0.0), touching, jnp.zeros((1, 3)), moved((0.0, 0.05), y), jnp.zeros(()))
        assert bool(score > checker.threshold) == allowed


def test_parked_obstacles_are_no_obstacles():
    checker = CollisionChecker()
    assert judge(checker, rope(0.05, 0.15), wall(active=False)) > checker.threshold


def test_the_baselines_keep_the_protocol():
    assert isinstance(Always(), Reliability)
    assert isinstance(CollisionChecker(), Reliability)
