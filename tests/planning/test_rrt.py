"""Trees: their invariants on made problems, their repeatability, what ends a search."""

import hashlib
import os
import subprocess
import sys
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.planning import Rrt, RrtSettings, check_problem, plan_of, search, simulated, simulated_start
from doojax.planning.rrt import _search, propagate
from doojax.types import Transition

from .problems import BLIND, CAREFUL, SIDE_BY_SIDE, TIMID, TOY, TRACES, Towed, batch, element, problem, walls

MARGIN = float(CAREFUL.threshold)
SMALL = RrtSettings(lanes=16, extensions=480, duration=8, candidates=2, stuck_after=16)
PLANNER = Rrt(Towed(), CAREFUL, TOY, SMALL)
RARE = replace(SMALL, stuck_after=40, random_accept=0.02)
LUCKY = Rrt(Towed(), CAREFUL, TOY, RARE)


def digest(tree) -> str:
    """Of every byte of the filled part of a batch of trees."""
    filled = int(np.asarray(tree.used).max())
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    parts = [leaf[:, :filled].tobytes() if leaf.ndim > 1 else leaf.tobytes() for leaf in leaves]
    return hashlib.sha256(b"".join(parts)).hexdigest()


place = st.tuples(st.floats(-0.45, 0.45), st.floats(-0.45, 0.45))
sizes = st.tuples(st.floats(0.01, 0.2), st.floats(0.01, 0.3))
angles = st.floats(-3.14, 3.14)
wall = st.fixed_dictionaries({"centre": place, "half": sizes, "yaw": angles, "active": st.booleans()})


@settings(max_examples=10, deadline=None)
@given(
    start=place,
    angle=angles,
    goal=place,
    wall=wall,
    seed=st.integers(0, 2**31 - 1),
    planner=st.sampled_from([PLANNER, LUCKY]),
)
def test_the_trees_invariants(start, angle, goal, wall, seed, planner):
    one = problem(start=start, angle=angle, goal=goal, obstacles=walls(**wall), seed=seed)
    alone = batch(one)
    tree = search(planner, alone)
    host, used = element(tree, 0), int(tree.used[0])
    lanes, random_accept = planner.settings.lanes, planner.settings.random_accept
    assert (used - 1) % lanes == 0 and used - 1 <= planner.settings.extensions

    # Slot 0 is the start; parents stand before their children and are themselves in the tree.
    slots = np.arange(1, used)
    parents = host.parent[slots]
    assert host.parent[0] == -1 and host.accepted[0]
    assert (parents < slots).all() and host.accepted[parents].all()
    assert np.array_equal(host.state.points[0], one.start.points)

    # Every edge re-simulates to its child, bit for bit, by the same function; rejected ones included.
    before = jax.tree.map(lambda leaf: leaf[np.maximum(host.parent, 0)], host.state)
    for first in range(1, used, lanes):
        own = slice(first, first + lanes)
        states, action = jax.tree.map(
            lambda leaf, own=own: jnp.broadcast_to(leaf[own], (SIDE_BY_SIDE, *leaf[own].shape)),
            (before, host.action),
        )
        after, _ = propagate(planner.dynamics, alone.obstacles, states, action)
        assert np.array_equal(after.points[0], host.state.points[own])
        assert np.array_equal(after.grippers[0], host.state.grippers[own])

    # Every accepted edge satisfies the constraint, judged anew, unless luck let it pass.
    score, valid = judged(planner.reliability, one.obstacles, before, host.action, host.state)
    assert np.asarray(score)[slots] == pytest.approx(host.score[slots], abs=1e-6)
    passed = host.score[slots] > MARGIN
    assert (host.accepted[slots] == passed).all() or random_accept > 0
    assert not (passed & ~host.accepted[slots]).any()
    assert np.asarray(valid)[slots].all()  # every action may be taken where it is taken

    # The plan starts at the start, follows edges, and ends as near to the goal as it claims and as can be.
    plan = plan_of(element(tree, 0))
    assert plan.nodes[0] == 0 and np.array_equal(host.parent[plan.nodes[1:]], plan.nodes[:-1])
    assert host.accepted[plan.nodes].all()
    tails = host.state.points[:used, 0]
    distances = np.linalg.norm(tails - np.asarray(one.goal.targets[0]), axis=-1)
    assert plan.goal_distance == pytest.approx(distances[plan.nodes[-1]], abs=1e-6)
    assert plan.goal_distance == pytest.approx(distances[host.accepted[:used]].min(), abs=1e-6)
    assert plan.extensions == used - 1 and plan.accepted == host.accepted[1:used].sum()
    solved = plan.goal_distance <= planner.settings.goal_margin * TOY.goal_threshold
    stuck = not host.accepted[1:used].any() and not solved
    assert plan.status == ("solved" if solved else "stuck" if stuck else "exhausted")
    if plan.status == "exhausted":
        assert used - 1 == planner.settings.extensions

    # One step at a time, by a function compiled for one state, the plan gets to the same place.
    state = one.start
    for action in plan.actions:
        state, _ = one_step(planner.dynamics, one.obstacles, state, action)
    assert np.asarray(state.points) == pytest.approx(plan.states.points[-1], abs=1e-5)


one_step = eqx.filter_jit(lambda dynamics, *arguments: dynamics(*arguments))


@eqx.filter_jit
def judged(reliability, obstacles, before, actions, after):
    steps = Transition(before, actions, after, jnp.zeros(len(actions)))
    found = jax.vmap(reliability, in_axes=(None, 0))(obstacles, steps)
    return found.score, jax.vmap(TOY.actions.valid)(before, actions)


def test_the_same_seed_gives_the_same_tree_and_another_does_not():
    first, again = (search(PLANNER, batch(problem(goal=(0.4, -0.3)))) for _ in range(2))
    other = search(PLANNER, batch(problem(goal=(0.4, -0.3), seed=1)))
    assert digest(first) == digest(again) != digest(other)


@pytest.mark.parametrize("search", [search, _search])  # in parts, and as accelerators do
def test_a_tree_does_not_depend_on_its_neighbours(search):
    around = walls(centre=(-0.3, 0.0), half=(0.4, 0.4))
    one, other = (
        search(PLANNER, batch(problem(goal=(0.4, -0.3), seed=5), neighbour))
        for neighbour in (problem(goal=(-0.44, 0.0)), problem(obstacles=around))
    )
    assert plan_of(element(other, 1)).status == "stuck"
    assert int(one.used[0]) > int(one.used[1]) and int(one.used[0]) > int(other.used[1])
    for mine, yours in zip(*(jax.tree.leaves(element(tree, 0)) for tree in (one, other)), strict=True):
        assert np.array_equal(mine, yours, equal_nan=True)


@pytest.mark.slow
def test_the_tree_is_the_same_on_any_device_of_any_number():
    code = """
import jax, sys
from tests.planning.test_rrt import PLANNER, batch, digest, problem, search
device = jax.devices()[int(sys.argv[1])]
print(len(jax.devices()), digest(search(PLANNER, jax.device_put(batch(problem(goal=(0.4, -0.3))), device))))
"""
    flags = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=3"}
    said = subprocess.run(
        [sys.executable, "-c", code, "2"], env=flags, capture_output=True, text=True, timeout=300
    )
    assert said.stdout.split() == ["3", digest(search(PLANNER, batch(problem(goal=(0.4, -0.3)))))], (
        said.stderr
    )


def test_another_problem_of_the_same_shape_compiles_nothing():
    search(PLANNER, batch(problem()))
    before = len(TRACES)
    search(PLANNER, batch(problem(goal=(0.1, 0.4), obstacles=walls(yaw=0.3), seed=3)))
    assert len(TRACES) == before


def test_where_everything_is_rejected_the_start_counts_as_stuck_at_once():
    planner = Rrt(Towed(), TIMID, TOY, SMALL)
    plan = plan_of(element(search(planner, batch(problem())), 0))
    assert (plan.status, plan.extensions, plan.accepted, len(plan.actions)) == ("stuck", 16, 0, 0)


def test_luck_lets_pass_as_many_as_asked_for_and_a_late_first_one_keeps_the_search_going():
    # Three expansions of 16 are tried before 40 attempts are over; only luck accepts anything.
    ends, tried, accepted = {}, 0, 0
    for seed in range(40):
        tree = element(search(Rrt(Towed(), TIMID, TOY, RARE), batch(problem(seed=seed))), 0)
        first = np.flatnonzero(np.asarray(tree.accepted)[1:])
        ends[first[0] // 16 if len(first) else 3] = bool(tree.stuck), int(tree.used)
        plan = plan_of(tree)
        tried, accepted = tried + plan.extensions, accepted + plan.accepted
    assert ends[2] == (False, 1 + RARE.extensions)
    assert ends[3] == (True, 1 + 48)
    # of a sum with a rule when to stop the mean is what it is without one
    assert abs(accepted / tried - 0.02) < 3 * (0.02 * 0.98 / tried) ** 0.5


def test_at_the_goal_already_the_plan_is_empty():
    plan = plan_of(element(search(PLANNER, batch(problem(start=(-0.3, 0.0), goal=(-0.5, 0.0)))), 0))
    assert (plan.status, len(plan.actions), plan.extensions) == ("solved", 0, 0)


def test_predictions_that_are_not_finite_never_enter_the_tree():
    planner = Rrt(Towed(jnp.array(-0.3)), BLIND, TOY, SMALL)
    host = element(search(planner, batch(problem(goal=(0.4, -0.3)))), 0)
    assert np.isnan(host.state.points).any() and 0 < host.accepted.sum() < host.used
    assert np.isfinite(host.state.points[host.accepted]).all()


def test_dynamics_outside_of_jit_grow_the_tree_that_they_grow_inside():
    class Outside:
        """Hides that the dynamics are a pytree."""

        @staticmethod
        def many(obstacles, states, actions):
            return propagate(Towed(), obstacles, states, actions)

    two = batch(problem(goal=(0.4, -0.3)), problem(obstacles=walls(centre=(-0.3, 0.0), half=(0.4, 0.4))))
    # the whole batch at once inside, too: batches of different sizes are rounded differently
    trees = [_search(Rrt(one, CAREFUL, TOY, SMALL), two) for one in (Towed(), Outside())]
    check_alike(*trees)


def check_alike(one, other):
    for inside, outside in zip(*map(jax.tree.leaves, (one, other)), strict=True):
        if inside.dtype == bool or jnp.issubdtype(inside.dtype, jnp.integer):
            assert np.array_equal(inside, outside)
        else:
            assert np.asarray(inside) == pytest.approx(np.asarray(outside), abs=1e-6, nan_ok=True)


@pytest.mark.slow  # beside it the same of dynamics that compile sooner
def test_a_simulator_outside_of_jit_grows_the_tree_that_it_grows_inside():
    simulator = TOY.simulator()
    states = jax.jit(jax.vmap(simulator.reset))(jax.random.split(jax.random.key(3), SIDE_BY_SIDE))
    starts = simulated_start(simulator, states)
    two = batch(problem(goal=(0.4, -0.3)), problem())
    two = eqx.tree_at(lambda p: p.start, two, starts)

    class Outside:  # hides that the simulator is a pytree
        def __init__(self, inner):
            for name in ("scene", "reset", "step", "observe", "observations", "obstacles", "rollout"):
                setattr(self, name, getattr(inner, name))

    # the whole batch at once inside, too: batches of different sizes are rounded differently
    trees = [_search(Rrt(simulated(one), BLIND, TOY, SMALL), two) for one in (simulator, Outside(simulator))]
    check_alike(*trees)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("lanes", 0, "lanes is 0, expected 1 to 16,384"),
        ("extensions", 0, "extensions is 0, expected 1 to 4,000,000"),
        ("candidates", -1, "candidates is -1, expected 1 to 4,096"),
        ("random_accept", 1.5, "random_accept is 1.5, expected 0 to 1"),
    ],
)
def test_settings_that_plan_nothing_are_refused(name, value, expected):
    with pytest.raises(ValueError, match=expected):
        RrtSettings(**{name: value})


def test_problems_that_nobody_could_solve_are_refused():
    check_problem(TOY, problem())
    with pytest.raises(ValueError, match=r"the goal \[0.9.*, 0.0.*\] lies outside of the workspace of toy"):
        check_problem(TOY, problem(goal=(0.9, 0.0)))
    with pytest.raises(ValueError, match=r"in collision at the start: point 4 of the rope is 2.0 cm inside"):
        check_problem(TOY, problem(start=(0.15, 0.0)))


def test_a_search_inside_of_jit_grows_the_tree_that_it_grows_outside():
    problems = batch(problem(goal=(0.4, -0.3)), problem(obstacles=walls(centre=(-0.3, 0.0), half=(0.4, 0.4))))
    outside = _search(PLANNER, problems)
    inside = jax.jit(lambda problems: search(PLANNER, problems))(problems)
    filled = int(outside.used.max())
    assert filled > 1 + SMALL.lanes and np.array_equal(inside.used, outside.used)
    assert np.array_equal(inside.parent[:, :filled], outside.parent[:, :filled])
    points = np.asarray(outside.state.points[:, :filled])
    assert np.asarray(inside.state.points[:, :filled]) == pytest.approx(points, abs=1e-5)


def test_a_search_inside_of_jit_with_dynamics_outside_of_it_is_an_error_that_says_so():
    class Outside:
        def many(self, obstacles, states, actions):
            raise AssertionError("never called")

    with pytest.raises(ValueError, match=r"inside of jax.jit with dynamics that run outside of it \(Outside"):
        jax.jit(lambda one: search(Rrt(Outside(), CAREFUL, TOY, SMALL), one))(batch(problem()))
