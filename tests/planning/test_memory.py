"""What was executed and came out otherwise is not proposed again."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from doojax.models import CollisionChecker, Conjunction
from doojax.planning import Rrt, plan_of, search
from doojax.planning.memory import PLACES, Outcome, refuting, remembered
from doojax.planning.settings import RrtSettings
from doojax.types import Transition

from .problems import SIDE_BY_SIDE, TOY, Clearance, Towed, batch, element, problem, walls
from .test_rrt import SMALL

HERE = np.zeros((2, 3), np.float32)
AHEAD = np.array([[0.1, 0.0, 0.0], [0.1, 0.0, 0.0]], np.float32)


def test_a_step_that_was_stopped_is_an_outcome_and_one_as_predicted_is_none():
    plan = np.stack([HERE + 0.03, HERE + 0.03 + AHEAD])  # 5 cm off before the step, which is not its fault
    assert refuting(HERE, HERE + AHEAD, plan, 0.02) is None
    outcome = refuting(HERE, HERE, plan, 0.02)
    assert outcome is not None and outcome.error == pytest.approx(0.1)
    np.testing.assert_allclose(outcome.change, AHEAD, atol=1e-7)
    half = HERE + np.array([[0.1, 0, 0], [0, 0, 0]])  # one of two bodies stayed: 10 cm / sqrt(2)
    assert refuting(HERE, half, plan, 0.02).error == pytest.approx(0.1 / 2**0.5)


@pytest.mark.parametrize(
    ("begins", "goes_on", "forbidden"),
    [
        ((0.0, 0.0), (0.1, 0.0), True),
        ((0.0, 0.049), (0.1, 0.0), True),  # the radius is half of the error of 10 cm
        ((0.0, 0.051), (0.1, 0.0), False),
        ((0.0, 0.0), (0.1, 0.049), True),
        ((0.0, 0.0), (0.1, 0.051), False),
        ((0.0, 0.0), (-0.1, 0.0), False),
    ],
)
def test_what_begins_and_goes_on_alike_is_forbidden(begins, goes_on, forbidden):
    known = remembered([Outcome(HERE, AHEAD, 0.1)], bodies=2)
    before = HERE + np.array([*begins, 0.0], np.float32)
    after = before + np.array([*goes_on, 0.0], np.float32)
    assert bool(known.forbids(jnp.asarray(before), jnp.asarray(after))) == forbidden


def test_nothing_is_forbidden_where_nothing_was_learned_and_the_last_outcomes_count():
    still = jnp.asarray(HERE)
    assert not remembered([], bodies=2).forbids(still, still)
    older = [Outcome(HERE + 9, AHEAD, 0.1)] * PLACES
    assert remembered([*older, Outcome(HERE, AHEAD, 0.1)], 2).forbids(still, jnp.asarray(AHEAD))
    assert not remembered([Outcome(HERE, AHEAD, 0.1), *older], 2).forbids(still, jnp.asarray(AHEAD))


class Unsure(Towed):
    """Says that every body may be off by so many metres after each step."""

    spread: Array = eqx.field(default_factory=lambda: jnp.array(0.0))

    def __call__(self, obstacles, state, action):
        after, _ = super().__call__(obstacles, state, action)
        return after, 6 * self.spread  # of five points and a gripper


LUCKY = replace(SMALL, random_accept=0.2)  # in all searches, so that one compiled search serves them


def searched(outcomes=(), spread=0.0, threshold=-jnp.inf, margin=-jnp.inf, **where):
    known = jax.tree.map(lambda leaf: jnp.stack([leaf] * SIDE_BY_SIDE), remembered(list(outcomes), 6))
    taught = eqx.tree_at(lambda p: p.refuted, batch(problem(**where)), known)
    judge = Conjunction((Clearance(jnp.array(threshold)), CollisionChecker(jnp.array(margin))))
    tree = element(search(Rrt(Unsure(spread=jnp.array(spread)), judge, TOY, LUCKY), taught), 0)
    return tree, plan_of(tree)


@pytest.mark.slow
def test_no_accepted_edge_of_a_tree_is_like_a_refuted_one():
    _, plan = searched(goal=(0.4, -0.3))
    bodies = np.concatenate([plan.states.points, plan.states.grippers], axis=1)
    outcome = Outcome(bodies[0], bodies[1] - bodies[0], 0.1)
    tree, again = searched([outcome], goal=(0.4, -0.3))
    assert not np.array_equal(again.actions[0], plan.actions[0])
    slots = np.flatnonzero(tree.accepted)[1:]
    before, after = (
        np.concatenate([tree.state.points[rows], tree.state.grippers[rows]], axis=1)
        for rows in (tree.parent[slots], slots)
    )
    begins = np.sqrt(((before - bodies[0]) ** 2).sum(-1).mean(-1))
    goes_on = np.sqrt(((after - before - outcome.change) ** 2).sum(-1).mean(-1))
    assert len(slots) > 100 and not ((begins < 0.0499) & (goes_on < 0.0499)).any()


@pytest.mark.slow
def test_luck_lets_pass_what_is_learned_and_never_what_is_physics():
    bypassed = []
    for margin in (0.0, -jnp.inf):  # the gripper and the rope may not touch the wall, or may
        tree, _ = searched(threshold=jnp.inf, margin=margin, start=(0.1, 0.0), goal=(0.4, -0.3))
        slots = np.flatnonzero(tree.accepted)[1:]
        before, after = (
            jax.tree.map(lambda leaf, r=rows: jnp.asarray(leaf[r]), tree.state)
            for rows in (tree.parent[slots], slots)
        )
        steps = Transition(before, jnp.asarray(tree.action[slots]), after, jnp.zeros(len(slots)))
        distance = jax.vmap(CollisionChecker().distance, (None, 0))(walls(), steps)
        bypassed.append((len(slots), int((distance <= 0).sum())))
    (allowed, through), (more, unchecked) = bypassed
    assert allowed > 20 and through == 0  # all by luck: the learned judge accepts nothing
    assert more > 20 and unchecked > 0


def test_the_margin_leaves_room_for_twice_the_spread():
    settings, tolerance = RrtSettings(goal_margin=0.6), jnp.array(0.05)
    for spread, expected in ((0.0, 0.03), (0.005, 0.03), (0.015, 0.02), (1.0, 0.01)):
        assert settings.reach(tolerance, jnp.array(spread)) == pytest.approx(expected)
    strict = replace(settings, goal_margin=0.1)
    assert strict.reach(tolerance, jnp.array(1.0)) == pytest.approx(0.005)


def test_plans_of_a_model_that_is_unsure_end_nearer_to_the_goal():
    ends = []
    for seed in range(12):
        tree, plan = searched(spread=0.006, obstacles=walls(active=False), seed=seed)
        spread = 0.006 * len(plan.actions) ** 0.5
        assert tree.spread[plan.nodes[-1]] == pytest.approx(spread, rel=1e-5)
        if plan.status == "solved" and 2 * spread > 0.02:
            assert plan.goal_distance <= max(0.05 - 2 * spread, 0.01) + 1e-6
            ends.append(plan.goal_distance)
    assert len(ends) >= 3
