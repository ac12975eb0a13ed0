"""Baselines that learn nothing, on scenes drawn by hand."""

import equinox as eqx
import jax.numpy as jnp
import pytest
from jax import Array
from jaxtyping import Float

from doojax.models import Always, CollisionChecker, Conjunction, Reliability, Stricter
from doojax.models.protocols import above
from doojax.types import Obstacles, RopeState, Transition
from tests.calls import called


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
    step = Transition(rope(-0.3, -0.2), jnp.zeros((1, 3)), next_state, jnp.zeros(()))
    return called(reliability, wall() if obstacles is None else obstacles, step)


def test_always_accepts_whatever_is_predicted():
    nonsense = rope(0.1, jnp.nan)
    found = Always()(wall(), Transition(rope(0.0), jnp.zeros((1, 3)), nonsense, jnp.array(jnp.inf)))
    assert found.accepted and found.possible


def test_the_collision_checker_scores_the_distance_to_the_nearest_obstacle():
    # the wall's near face is at x = 0.09 and the rope ends 4 cm before it
    found = judge(CollisionChecker(), rope(0.0, 0.05))
    assert found.score == pytest.approx(0.04, abs=1e-6) and found.accepted and found.possible
    near = judge(CollisionChecker(), rope(0.0, 0.075))
    assert not near.accepted and not near.possible


def test_a_link_does_not_slip_through_a_wall_thinner_than_its_length():
    through = rope(0.05, 0.15)  # both points are 4 cm from the wall, which lies between them
    assert judge(CollisionChecker(), through).score == pytest.approx(-0.01, abs=1e-6)
    assert judge(CollisionChecker(points_only=True), through).score == pytest.approx(0.04, abs=1e-6)


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


def step(before, after):
    return Transition(before, jnp.zeros((1, 3)), after, jnp.zeros(()))


def test_a_motion_that_cuts_a_corner_with_both_ends_clear_is_noticed():
    # across a post: before and after it every link is 8 cm from its middle, so 6 cm from its face
    across = step(moved((0.0, 0.05), -0.08), moved((0.0, 0.05), 0.08))
    score = called(CollisionChecker(), post(0.0, 0.0), across).score
    assert score == pytest.approx(-0.02, abs=1e-5)  # the first point goes through the middle
    assert called(CollisionChecker(points_only=True), post(0.0, 0.0), across).score == pytest.approx(0.06)


def test_the_gripper_is_looked_at_too():
    # the post stands where only the gripper passes, and then where only the gripper ends
    before = moved((0.0, 0.05), -0.08)
    for y in (0.08, 0.01):
        found = called(CollisionChecker(), post(0.11, 0.0), step(before, moved((0.0, 0.05), y)))
        assert -0.02 <= found.score < -0.005 and not found.possible


def test_a_rope_that_touches_something_may_leave_it_but_not_go_on():
    checker, touching = CollisionChecker(), moved((0.0, 0.05), -0.03)  # 1 cm from the post's face
    for y, allowed in ((-0.06, True), (-0.025, False)):
        found = called(checker, post(0.0, 0.0), step(touching, moved((0.0, 0.05), y)))
        assert bool(found.accepted) == allowed


def test_parked_obstacles_are_no_obstacles():
    assert judge(CollisionChecker(), rope(0.05, 0.15), wall(active=False)).accepted


class Bodies(eqx.Module):
    """Two things that nothing joins."""

    places: Float[Array, "*b 2 3"]
    passive = 1

    def bodies(self):
        return self.places


def test_what_is_no_rope_has_no_links_between_its_bodies_but_ways():
    checker = CollisionChecker()
    before = jnp.array([[0.0, -0.1, 0.0], [0.0, 0.1, 0.0]])  # on both sides of the post
    aside = Bodies(before + jnp.array([-0.1, 0.0, 0.0]))
    assert called(checker, post(0.0, 0.0), step(Bodies(before), aside)).score == pytest.approx(0.08 * 2**0.5)
    changed = Bodies(before[::-1])  # each goes where the other was, through the middle
    assert called(checker, post(0.0, 0.0), step(Bodies(before), changed)).score == pytest.approx(
        -0.02, abs=1e-5
    )


class Said(eqx.Module):
    """A judge that says what it is told to."""

    score: float
    threshold: float

    def __call__(self, obstacles, transition):
        return above(jnp.asarray(self.score), self.threshold)


@pytest.mark.parametrize("x", [0.05, 0.075])  # 4 cm and 1.5 cm from the wall; the margin is 2 cm
@pytest.mark.parametrize("score", [0.3, 0.7])
def test_a_conjunction_accepts_what_all_accept_and_luck_never_beats_physics(x, score):
    both = Conjunction((Said(score, 0.5), CollisionChecker()))
    found = judge(both, rope(0.0, x))
    assert isinstance(both, Reliability)
    assert found.score == pytest.approx(score)
    assert bool(found.possible) == (x == 0.05)
    assert bool(found.accepted) == (x == 0.05 and score == 0.7)


def test_a_conjunction_of_nothing_is_refused():
    with pytest.raises(ValueError, match="at least one judge"):
        Conjunction(())


def test_a_stricter_judge_gives_the_same_scores_and_accepts_less():
    found = judge(Stricter(Said(0.7, 0.5), 0.8), rope(0.0, 0.05))
    assert found.score == pytest.approx(0.7) and not found.accepted and found.possible


def test_the_baselines_keep_the_protocol():
    assert isinstance(Always(), Reliability)
    assert isinstance(CollisionChecker(), Reliability)
