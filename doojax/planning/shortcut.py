"""Shorter plans by shortcuts through a plan, every step of them judged anew (thesis section 2.3.5).

A shortcut takes what is commanded, such as grippers, straight from where it is at one state of the plan to
where it is at a later one, in fewer actions, and then goes on as the plan does. The rope lies elsewhere after
it, so all that follows is predicted and judged again, by the same dynamics and the same constraint as in the
search.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.actions import ActionSpace
from doojax.models.protocols import Reliability
from doojax.planning.expansion import judged, spread_after
from doojax.planning.protocols import Task
from doojax.planning.rrt import Rrt, propagate
from doojax.planning.tree import Plan, Problem, Tree
from doojax.types import State, Transition


def shortened(planner: Rrt, problem: Problem, tree: Tree, plan: Plan) -> tuple[Tree, Plan]:
    """A plan of fewer actions, if one is found, and the tree with its new nodes after the others.

    ``planner.settings.shortcuts`` times as many shortcuts as the planner has lanes are tried side by side,
    and the one that reaches the goal by the fewest actions is kept. No step is let pass by luck. Every step
    that is predicted for a shortcut is an extension, and the plan that is returned counts it.

    Args:
        planner: that of the search.
        problem: one.
        tree: its tree, on the host.
        plan: the tree's; returned as it is unless it solves the problem and shortcuts are tried.
    """
    if plan.status != "solved":
        return tree, plan
    rng = np.random.default_rng(np.asarray(jax.random.key_data(problem.key)))
    for _ in range(planner.settings.shortcuts):
        if len(plan.actions) < 2:
            break
        tree, plan = _round(planner, problem, tree, plan, rng)
    return tree, plan


def _round(
    planner: Rrt, problem: Problem, tree: Tree, plan: Plan, rng: np.random.Generator
) -> tuple[Tree, Plan]:
    lanes, length = planner.settings.lanes, len(plan.actions)
    leave = rng.integers(0, length - 1, lanes)
    arrive = rng.integers(leave + 2, length + 1)
    moves = rng.integers(0, arrive - leave)
    space = planner.task.actions
    sequences = [_sequence(space, plan, *choice) for choice in np.stack([leave, arrive, moves], 1).tolist()]
    ends = np.array([len(sequence) for sequence in sequences])
    actions = np.zeros((ends.max(), lanes, *plan.actions.shape[1:]), np.float32)
    for lane, sequence in enumerate(sequences):
        actions[: len(sequence), lane] = sequence

    obstacles = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], problem.obstacles)
    states = jax.tree.map(lambda leaf: jnp.asarray(leaf[plan.nodes[leave]]), tree.state)
    spread = jnp.asarray(tree.spread[plan.nodes[leave]])
    going, steps = np.ones(lanes, dtype=bool), []
    tried = accepted = 0
    best: tuple[int, float, int, int] | None = None  # actions, metres from the goal, lane, steps of the lane
    for step, action in enumerate(actions):
        before = jax.tree.map(lambda leaf: leaf[None], states)
        after, uncertainty = propagate(planner.dynamics, obstacles, before, jnp.asarray(action)[None])
        after, uncertainty = jax.tree.map(lambda leaf: leaf[0], (after, uncertainty))
        steps_now = Transition(states, jnp.asarray(action), after, uncertainty)
        found = _judge(planner.task, planner.reliability, problem, steps_now)
        score, fine, distance = (np.asarray(values) for values in found)
        spread = spread_after(spread, uncertainty, after)
        there = distance <= np.asarray(planner.settings.reach(jnp.asarray(problem.goal.tolerance), spread))
        going &= step < ends
        tried += int(going.sum())
        going &= fine
        accepted += int(going.sum())
        steps.append((jax.tree.map(np.asarray, after), score, distance, np.asarray(spread)))
        for lane in np.flatnonzero(going & there):
            reached = (int(leave[lane]) + step + 1, float(distance[lane]), int(lane), step + 1)
            best = reached if best is None else min(best, reached)
        going &= ~there
        if not going.any():
            break
        states = after
    plan = plan._replace(extensions=plan.extensions + tried, accepted=plan.accepted + accepted)
    if best is None or best[0] >= length:
        return tree, plan
    _, _, lane, count = best
    return _grafted(tree, plan, int(leave[lane]), actions[:count, lane], lane, steps[:count])


def _sequence(
    space: ActionSpace, plan: Plan, leave: int, arrive: int, moves: int
) -> Float[np.ndarray, "t ..."]:
    """The actions of a shortcut, and what the plan does after it."""
    first, last = (jax.tree.map(lambda leaf, i=i: leaf[i], plan.states) for i in (leave, arrive))
    straight = np.asarray(space.between(first, last, moves))
    return np.concatenate([np.repeat(straight[None], moves, axis=0), plan.actions[arrive:]])


@eqx.filter_jit
def _judge(
    task: Task, reliability: Reliability, problem: Problem, steps: Transition
) -> tuple[Float[Array, "L"], Bool[Array, "L"], Float[Array, "L"]]:
    """Of each step: its score, may it be in a plan, and the metres to the goal after it."""
    found, sound, distance = judged(reliability, problem, steps)
    allow = jax.vmap(task.actions.valid)(steps.state, steps.action)
    return found.score, sound & allow & found.accepted, distance


def _grafted(
    tree: Tree,
    plan: Plan,
    leave: int,
    actions: Float[np.ndarray, "t ..."],
    lane: int,
    steps: list[tuple[State, np.ndarray, np.ndarray, np.ndarray]],
) -> tuple[Tree, Plan]:
    """The tree with the steps of one lane behind the plan's node number ``leave``.

    On the host: JAX would compile its operations anew for each number of steps.
    """
    used, count = int(tree.used), len(actions)
    fresh = np.arange(used, used + count)
    added = Tree(
        state=jax.tree.map(
            lambda *leaves: jnp.asarray(np.stack([leaf[lane] for leaf in leaves])),
            *(step[0] for step in steps),
        ),
        action=jnp.asarray(actions),
        parent=jnp.asarray(np.array([plan.nodes[leave], *fresh[:-1]], dtype=np.int32)),
        accepted=jnp.asarray(np.ones(count, dtype=bool)),
        score=jnp.asarray(np.array([score[lane] for _, score, _, _ in steps])),
        goal_distance=jnp.asarray(np.array([distance[lane] for _, _, distance, _ in steps])),
        spread=jnp.asarray(np.array([spread[lane] for *_, spread in steps])),
        reached=jnp.asarray(np.arange(count) == count - 1),
        used=jnp.asarray(used + count, dtype=jnp.int32),
        solved=jnp.asarray(tree.solved),
        stuck=jnp.asarray(tree.stuck),
    )
    grown = jax.tree.map(
        lambda old, new: np.concatenate([old[:used], new]) if new.ndim else np.asarray(new), tree, added
    )
    nodes = np.concatenate([plan.nodes[: leave + 1], fresh])
    return grown, plan._replace(
        nodes=nodes,
        actions=grown.action[nodes[1:]],
        states=jax.tree.map(lambda leaf: leaf[nodes], grown.state),
        goal_distance=float(grown.goal_distance[-1]),
    )
