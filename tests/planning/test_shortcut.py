"""Shortcuts: shorter, judged anew, on the tree, the same every time."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.planning import Rrt, plan_of, search, shortened
from doojax.planning.rrt import propagate
from doojax.planning.tree import Plan, Tree
from doojax.tasks import gripper_goal
from doojax.tasks.toy import HEIGHT
from doojax.types import Transition

from .problems import CAREFUL, TIMID, TOY, Towed, batch, element, problem, walls
from .test_rrt import PLANNER, SMALL

SMOOTH = Rrt(Towed(), CAREFUL, TOY, replace(SMALL, shortcuts=3))
place = st.tuples(st.floats(-0.45, 0.45), st.floats(-0.45, 0.45))


@settings(max_examples=8, deadline=None)
@given(start=place, goal=place, yaw=st.floats(-3.14, 3.14), seed=st.integers(0, 2**31 - 1))
def test_a_shortened_plan_is_still_a_plan(start, goal, yaw, seed):
    one = problem(start=start, goal=goal, obstacles=walls(yaw=yaw), seed=seed)
    tree = element(search(PLANNER, batch(one)), 0)
    plan = plan_of(tree)
    grown, short = shortened(SMOOTH, one, tree, plan)
    assert len(short.actions) <= len(plan.actions)
    assert short.status == plan.status
    tried, accepted = short.extensions - plan.extensions, short.accepted - plan.accepted
    assert 0 <= accepted <= tried and (tried > 0) == (plan.status == "solved" and len(plan.actions) > 1)
    if plan.status != "solved":
        assert short is plan
        return

    # It goes from the start to the goal along edges of the tree, whose old part is as it was.
    assert short.nodes[0] == 0 and np.array_equal(grown.parent[short.nodes[1:]], short.nodes[:-1])
    assert np.array_equal(grown.action[short.nodes[1:]], short.actions)
    old, now = (leaf[: int(tree.used)] for leaf in (tree.state.points, grown.state.points))
    assert np.array_equal(old, now)
    tail = grown.state.points[short.nodes[-1], 0]
    assert short.goal_distance == pytest.approx(np.linalg.norm(tail - one.goal.targets[0]), abs=1e-6)
    assert short.goal_distance <= SMALL.goal_margin * TOY.goal_threshold

    # Every step, predicted again, is what the tree says bit for bit, and is accepted and allowed.
    obstacles = jax.tree.map(lambda leaf: leaf[None], one.obstacles)
    for node in short.nodes[1:]:
        before = jax.tree.map(lambda leaf, n=node: jnp.asarray(leaf[grown.parent[n]]), grown.state)
        action = jnp.asarray(grown.action[node])
        alike = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (1, SMALL.lanes, *leaf.shape)), before)
        after, _ = propagate(SMOOTH.dynamics, obstacles, alike, jnp.tile(action, (1, SMALL.lanes, 1, 1)))
        assert np.array_equal(after.points[0, 0], grown.state.points[node])
        here = jax.tree.map(lambda leaf: leaf[0, 0], after)
        assert all(judged(one.obstacles, Transition(before, action, here, jnp.zeros(()))))

    again = shortened(SMOOTH, one, tree, plan)[1]
    assert np.array_equal(again.actions, short.actions)


@jax.jit
def judged(obstacles, step):
    """Is a step accepted, and allowed?"""
    return CAREFUL(obstacles, step).accepted, TOY.actions.valid(step.state, step.action)


def zigzag() -> tuple[Plan, Tree, object]:
    """Six moves of 4 cm that take the gripper 8 cm along x, which one move can do, and a goal there."""
    one = problem(start=(-0.3, 0.0), obstacles=walls(active=False))
    moves = 0.04 * np.array([[0, 1, 0], [1, 0, 0], [0, -1, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    states = [one.start]
    for move in moves:
        states.append(Towed()(None, states[-1], jnp.asarray(move)[None])[0])
    aim = gripper_goal(TOY, one.start.grippers + jnp.array([0.08, 0.0, 0.0]))
    one = type(one)(one.obstacles, one.start, aim, one.key)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    distances = jnp.stack([aim.distance(state) for state in states])
    count = len(states)
    tree = Tree(
        state=stacked,
        action=jnp.concatenate([jnp.zeros((1, 1, 3)), moves[:, None]]),
        parent=jnp.arange(-1, count - 1),
        accepted=jnp.ones(count, bool),
        score=jnp.ones(count),
        goal_distance=distances,
        spread=jnp.zeros(count),
        reached=jnp.arange(count) == count - 1,
        used=jnp.array(count),
        solved=jnp.array(True),
        stuck=jnp.array(False),
    )
    tree = jax.tree.map(np.asarray, tree)
    return plan_of(tree), tree, one


def test_a_detour_becomes_one_straight_move():
    plan, tree, one = zigzag()
    assert len(plan.actions) == 6 and plan.nodes.tolist() == list(range(7))
    _, short = shortened(rounds(20), one, tree, plan)
    assert short.actions == pytest.approx(np.array([[[0.08, 0.0, 0.0]]]), abs=1e-6)
    assert short.states.grippers[-1, 0] == pytest.approx([-0.22, 0.0, HEIGHT], abs=1e-6)


def test_what_is_not_accepted_is_no_shortcut():
    plan, tree, one = zigzag()
    timid = Rrt(Towed(), TIMID, TOY, replace(SMALL, shortcuts=20))
    grown, short = shortened(timid, one, tree, plan)
    assert np.array_equal(short.nodes, plan.nodes) and grown is tree


def test_shortcuts_are_extensions_and_are_counted():
    plan, tree, one = zigzag()
    lanes = SMALL.lanes
    for shortcuts in (1, 3):  # nothing is accepted: every shortcut with an action tries just one step
        timid = Rrt(Towed(), TIMID, TOY, replace(SMALL, shortcuts=shortcuts))
        _, short = shortened(timid, one, tree, plan)
        tried = short.extensions - plan.extensions
        assert shortcuts * lanes / 2 < tried <= shortcuts * lanes and short.accepted == plan.accepted
    _, free = shortened(rounds(1), one, tree, plan)  # nothing is in the way: all steps are accepted
    assert free.extensions - plan.extensions == free.accepted - plan.accepted > 0
    assert shortened(rounds(0), one, tree, plan)[1].extensions == plan.extensions


def test_none_are_tried_where_none_are_wanted():
    plan, tree, one = zigzag()
    assert shortened(rounds(0), one, tree, plan)[1] is plan
    with pytest.raises(ValueError, match="shortcuts is -1, expected 0 to 1,000"):
        rounds(-1)


def rounds(number: int) -> Rrt:
    return Rrt(Towed(), CAREFUL, TOY, replace(SMALL, shortcuts=number))
