"""What one expansion of a tree does: what its lanes try, and what becomes of it. All of one problem.

A lane carries one action along for several steps, as the thesis's planner does, until its duration is over
or a step is rejected; then it starts anew at the node nearest to a fresh sample.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.random import fold_in
from jaxtyping import Array, Bool, Float, Int

from doojax.actions import nothing_of
from doojax.models.protocols import Reliability
from doojax.planning.metric import Sampler, nearest
from doojax.planning.protocols import Task
from doojax.planning.settings import RrtSettings
from doojax.planning.tree import Problem, Tree
from doojax.types import Judgement, State, Transition

PARTS = 2  # of the lanes, that begin anew one after another


class Lanes(eqx.Module):
    """What each of L lanes is about to try."""

    node: Int[Array, "*b L"]  # slot to extend from
    action: Float[Array, "..."]  # [*b, L, ...]
    remaining: Int[Array, "*b L"]  # steps for which the action is still to be held; 0 for a lane that is free
    lucky: Bool[Array, "*b L"]  # accepted whatever the score


def start(task: Task, settings: RrtSettings, problem: Problem) -> tuple[Tree, Lanes]:
    """A tree of its root alone, and lanes that are all free."""
    root, nothing = problem.start, nothing_of(task.actions)
    capacity = 1 + settings.expansions * settings.lanes
    distance = problem.goal.distance(root)
    there = distance <= settings.reach(problem.goal.tolerance, jnp.zeros(()))
    tree = Tree(
        state=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (capacity, *leaf.shape)), root),
        action=jnp.broadcast_to(nothing, (capacity, *nothing.shape)),
        parent=jnp.full(capacity, -1, dtype=jnp.int32),
        accepted=jnp.arange(capacity) == 0,
        score=jnp.full(capacity, jnp.nan, dtype=jnp.float32),
        goal_distance=jnp.full(capacity, distance),
        spread=jnp.zeros(capacity, dtype=jnp.float32),
        reached=(jnp.arange(capacity) == 0) & there,
        used=jnp.array(1, dtype=jnp.int32),
        solved=there,
        stuck=jnp.array(False),
    )
    lanes = Lanes(
        node=jnp.zeros(settings.lanes, dtype=jnp.int32),
        action=jnp.broadcast_to(nothing, (settings.lanes, *nothing.shape)),
        remaining=jnp.zeros(settings.lanes, dtype=jnp.int32),
        lucky=jnp.zeros(settings.lanes, dtype=bool),
    )
    return tree, lanes


def propose(
    task: Task,
    settings: RrtSettings,
    sampler: Sampler,
    problem: Problem,
    tree: Tree,
    lanes: Lanes,
    first: Int[Array, ""],
) -> tuple[Lanes, State]:
    """What every lane tries next, and the states that it starts from."""
    key = fold_in(problem.key, first)
    draw_key, sample_key, action_key = jax.random.split(key, 3)
    draws = jax.random.uniform(draw_key, (4, settings.lanes))

    valid = jax.vmap(task.actions.valid)(_at(tree.state, lanes.node), lanes.action)
    held = (lanes.remaining > 0) & valid
    direct = jax.vmap(lambda *arguments: _directed_action(task, settings.candidates, *arguments))

    def begin_anew(some: Int[Array, "P"]) -> tuple[Int[Array, "P"], Float[Array, "P ..."]]:
        """Where some lanes begin, and what they are about to do."""
        # The shape of any state of the tree: where that was rejected, its parent's.
        slots = jnp.minimum(draws[0, some] * first, first - 1).astype(jnp.int32)
        slots = jnp.where(tree.accepted[slots], slots, tree.parent[slots])
        sample_keys, action_keys = (
            jax.vmap(fold_in, (None, 0))(key, some) for key in (sample_key, action_key)
        )
        samples = jax.vmap(sampler, in_axes=(0, None, 0, None, 0))(
            sample_keys,
            task.workspace,
            _at(tree.state, slots).bodies(),
            problem.goal,
            draws[1, some] < settings.goal_bias,
        )
        node = nearest(samples, tree.state, tree.accepted, first)
        return node, direct(action_keys, _at(tree.state, node), samples)

    # Most lanes carry on: only a part at a time begins anew, until all have that are free.
    part = -(-settings.lanes // PARTS)
    free_first = jnp.pad(jnp.argsort(held), (0, PARTS * part - settings.lanes), mode="edge")

    def begin_part(index: Int[Array, ""], begun: tuple[Array, Array]) -> tuple[Array, Array]:
        some = jax.lax.dynamic_slice_in_dim(free_first, index * part, part)
        return jax.tree.map(lambda old, new: old.at[some].set(new), begun, begin_anew(some))

    parts = -(-(~held).sum() // part)
    fresh_node, fresh = jax.lax.fori_loop(0, parts, begin_part, (lanes.node, lanes.action))
    node = jnp.where(held, lanes.node, fresh_node)
    parents = _at(tree.state, node)
    duration = 1 + jnp.minimum(draws[2] * settings.duration, settings.duration - 1).astype(jnp.int32)
    proposed = Lanes(
        node=node,
        action=jnp.where(held.reshape(-1, *[1] * (fresh.ndim - 1)), lanes.action, fresh),
        remaining=jnp.where(held, lanes.remaining, duration),
        lucky=draws[3] < settings.random_accept,
    )
    return proposed, parents


def _directed_action(
    task: Task, candidates: int, key: Array, state: State, sample: Float[Array, "K 3"]
) -> Float[Array, "..."]:
    """Of the valid ones of some random actions, that which brings what is commanded nearest to the sample."""
    space = task.actions
    actions = jax.vmap(space.draw)(jax.random.split(key, candidates))
    valid = jax.vmap(lambda action: space.valid(state, action))(actions)
    distance = jax.vmap(lambda action: space.missing(state, action, sample))(actions)
    best = jnp.argmin(jnp.where(valid, distance, jnp.inf))
    return jnp.where(valid.any(), actions[best], space.retreat(state))


def insert(
    settings: RrtSettings,
    reliability: Reliability,
    first: Int[Array, ""],
    tree: Tree,
    problem: Problem,
    lanes: Lanes,
    parents: State,
    after: State,
    uncertainty: Float[Array, "L"],
) -> tuple[Tree, Lanes]:
    """The tree with what was tried, and the lanes where they got to. A tree that is done stays as it is."""
    steps = Transition(parents, lanes.action, after, uncertainty)
    found, sound, distance = judged(reliability, problem, steps)
    accepted = sound & (found.accepted | lanes.lucky)
    done = tree.solved | tree.stuck
    accepted &= ~done

    def write(into, values):
        return jax.lax.dynamic_update_slice_in_dim(into, values.astype(into.dtype), first, axis=0)

    spread = spread_after(tree.spread[lanes.node], uncertainty, after)
    near = accepted & (distance <= settings.reach(problem.goal.tolerance, spread))
    used = jnp.where(done, tree.used, first + settings.lanes)
    everything = write(tree.accepted, accepted)
    tried_enough = used > settings.stuck_after
    # Once one attempt has succeeded it never will be stuck, so that the first few tell.
    any_yet = everything[1 : 1 + -(-settings.stuck_after // settings.lanes) * settings.lanes].any()
    grown = Tree(
        state=jax.tree.map(write, tree.state, after),
        action=write(tree.action, lanes.action),
        parent=write(tree.parent, lanes.node),
        accepted=everything,
        score=write(tree.score, found.score),
        goal_distance=write(tree.goal_distance, distance),
        spread=write(tree.spread, spread),
        reached=write(tree.reached, near),
        used=used,
        solved=tree.solved | near.any(),
        stuck=tree.stuck | (tried_enough & ~any_yet & ~tree.solved),
    )
    moved = Lanes(
        node=first + jnp.arange(settings.lanes),
        action=lanes.action,
        remaining=jnp.where(accepted, lanes.remaining - 1, 0),
        lucky=lanes.lucky,
    )
    return grown, moved


def _at(states: State, slots: Int[Array, "L"]) -> State:
    return jax.tree.map(lambda leaf: leaf[slots], states)


def judged(
    reliability: Reliability, problem: Problem, steps: Transition
) -> tuple[Judgement, Bool[Array, "L"], Float[Array, "L"]]:
    """Of L predicted steps of one problem: the judgements, are they sound, and the metres to the goal after.

    Those are sound that are finite, possible, and not like one that was executed with another outcome.
    """
    found = jax.vmap(reliability, in_axes=(None, 0))(problem.obstacles, steps)
    there = steps.next_state.bodies()
    sound = jnp.isfinite(there).all((-1, -2)) & found.possible
    if problem.refuted is not None:
        sound &= ~jax.vmap(problem.refuted.forbids)(steps.state.bodies(), there)
    return found, sound, jax.vmap(problem.goal.distance)(steps.next_state)


def spread_after(
    before: Float[Array, "*b"], uncertainty: Float[Array, "*b"], state: State
) -> Float[Array, "*b"]:
    """Metres by which a body may be off after a step, as its state was by ``before``.

    What a dynamics' uncertainty adds is its mean over the bodies, independent of what came before.
    """
    return jnp.hypot(before, uncertainty / state.bodies().shape[-2])
