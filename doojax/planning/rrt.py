"""Kinodynamic RRT that grows many branches at once (LaValle and Kuffner 2001; thesis section 2.3.5).

A tree lives in arrays of a fixed size: slot 0 is the start, and every attempted extension takes the next
slot, whether it was accepted or not. An expansion has three parts, each for all lanes of all problems:
propose (sample, nearest node, action), propagate (the dynamics), insert (the constraint, the goal). Many
expansions are one compiled call; where the dynamics run outside of JAX, as a simulator in C does, each part
is a call of its own.

Every step of a lane is an extension, and every budget counts extensions; what a lane does, says
`doojax.planning.expansion`.
"""

from functools import partial
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from doojax.models.protocols import Dynamics, Reliability
from doojax.parts import in_parts, traced, worth_parts
from doojax.planning import expansion
from doojax.planning.expansion import Lanes
from doojax.planning.metric import Sampler, rope_sample
from doojax.planning.protocols import Task
from doojax.planning.settings import RrtSettings
from doojax.planning.tree import Problem, Tree
from doojax.types import Obstacles, State

AT_ONCE = 64  # expansions in one call


@runtime_checkable
class HostDynamics(Protocol):
    """Dynamics of many elements that run outside of jit, such as a simulator in C."""

    def many(
        self, obstacles: Any, states: Any, actions: Float[Array, "R L ..."]
    ) -> tuple[Any, Float[Array, "R L"]]:
        """What `Dynamics` gives, for L states of each of R problems."""
        ...


class Rrt(eqx.Module):
    """A planner for one task with one model."""

    dynamics: Dynamics | HostDynamics
    reliability: Reliability
    task: Task = eqx.field(static=True)
    settings: RrtSettings = eqx.field(static=True, default=RrtSettings())
    sampler: Sampler = eqx.field(static=True, default=rope_sample)


def search(planner: Rrt, problem: Problem) -> Tree:
    """Grow a tree for each of R problems, side by side, until it is done or the budget is spent.

    The trees of a batch do not depend on one another. On a CPU each processor grows one at a time. Inside of
    `jax.jit` the whole search is one loop.

    Raises:
        ValueError: inside of `jax.jit`, for dynamics that run outside of it.
    """
    if not isinstance(planner.dynamics, HostDynamics) and worth_parts(1, problem, planner):
        return in_parts(partial(_search, planner), 1, problem)
    return _search(planner, problem)


def _search(planner: Rrt, problem: Problem) -> Tree:
    settings = planner.settings
    outside, inside_jit = isinstance(planner.dynamics, HostDynamics), traced(planner, problem)
    if outside and inside_jit:
        raise ValueError(
            "search was called inside of jax.jit with dynamics that run outside of it "
            f"({type(planner.dynamics).__name__}): call it outside, or plan with dynamics that are JAX "
            "functions, such as a simulator with engine='mjx'"
        )
    grow = _grow_outside if outside else _grow
    tree, lanes = _start(planner.task, settings, problem)
    first, end = 1, 1 + settings.expansions * settings.lanes
    if inside_jit:  # nobody can look how far it got: the loop ends itself when all problems are done
        return _grow((planner, problem, lanes, jnp.asarray([first, end], dtype=jnp.int32)), tree)[0]
    while first < end:
        until = min(first + AT_ONCE * settings.lanes, end)
        slots = jnp.asarray([first, until], dtype=jnp.int32)
        tree, lanes = grow((planner, problem, lanes, slots), tree)
        if np.asarray(tree.solved | tree.stuck).all():
            break
        first = until
    return tree


def propagate(
    dynamics: Dynamics | HostDynamics, obstacles: Obstacles, states: State, actions: Array
) -> tuple[State, Array]:
    """What the dynamics give for L states of each of R problems: bit for bit what a search got from them."""
    if isinstance(dynamics, HostDynamics):
        return dynamics.many(obstacles, states, actions)
    return _propagate_jitted(dynamics, obstacles, states, actions)


@eqx.filter_jit(donate="all-except-first")
def _grow(arguments: tuple, tree: Tree) -> tuple[Tree, Lanes]:
    """Expand until all problems are done or the slots are filled."""
    planner, problem, lanes, (first, until) = arguments

    def unfinished(carry):
        first, tree, _ = carry
        return (first < until) & ~(tree.solved | tree.stuck).all()

    def expand(carry):
        first, tree, lanes = carry
        lanes, parents = _propose(
            planner.task, planner.settings, planner.sampler, problem, tree, lanes, first
        )
        tried = _propagate(planner.dynamics, problem.obstacles, parents, lanes.action)
        return first + planner.settings.lanes, *_insert(planner, problem, first, tree, lanes, parents, *tried)

    _, tree, lanes = jax.lax.while_loop(unfinished, expand, (first, tree, lanes))
    return tree, lanes


def _grow_outside(arguments: tuple, tree: Tree) -> tuple[Tree, Lanes]:
    """The same where the dynamics cannot be compiled."""
    planner, problem, lanes, (first, until) = arguments
    judge = eqx.tree_at(lambda p: p.dynamics, planner, None)
    for slot in range(int(first), int(until), planner.settings.lanes):
        at = jnp.asarray(slot, dtype=jnp.int32)
        lanes, parents = _propose_jitted(
            planner.task, planner.settings, planner.sampler, problem, tree, lanes, at
        )
        tried = planner.dynamics.many(problem.obstacles, parents, lanes.action)
        tree, lanes = _insert_jitted((judge, problem, at, lanes, parents, *tried), tree)
        if np.asarray(tree.solved | tree.stuck).all():
            break
    return tree, lanes


@eqx.filter_jit
def _start(task: Task, settings: RrtSettings, problem: Problem) -> tuple[Tree, Lanes]:
    return jax.vmap(lambda one: expansion.start(task, settings, one))(problem)


def _propose(
    task: Task,
    settings: RrtSettings,
    sampler: Sampler,
    problem: Problem,
    tree: Tree,
    lanes: Lanes,
    first: Int[Array, ""],
) -> tuple[Lanes, State]:
    def one(problem, tree, lanes):
        return expansion.propose(task, settings, sampler, problem, tree, lanes, first)

    return jax.vmap(one)(problem, tree, lanes)


def _propagate(dynamics, obstacles, states, actions):
    return jax.vmap(jax.vmap(dynamics, in_axes=(None, 0, 0)))(obstacles, states, actions)


def _insert(planner: Rrt, problem: Problem, first: Int[Array, ""], tree: Tree, *tried) -> tuple[Tree, Lanes]:
    def one(tree, problem, *tried):
        return expansion.insert(planner.settings, planner.reliability, first, tree, problem, *tried)

    return jax.vmap(one)(tree, problem, *tried)


_propose_jitted = eqx.filter_jit(_propose)
_propagate_jitted = eqx.filter_jit(_propagate)


@eqx.filter_jit(donate="all-except-first")
def _insert_jitted(arguments: tuple, tree: Tree) -> tuple[Tree, Lanes]:
    planner, problem, first, *tried = arguments
    return _insert(planner, problem, first, tree, *tried)
