"""Trials: plan, execute in the simulator, recover where the planner is stuck, until the goal or the end.

A trial remembers the executed steps that were not as predicted: no later search of it proposes the like.

Trials of one method run side by side, as one batch of arrays, and do not depend on one another. What ends a
trial is counted in searches and actions, so that results do not depend on the machine; the seconds that
planning took are noted beside.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from doojax.actions import nothing_of
from doojax.environments.observations import features, taken
from doojax.experiments.trials.carried import refusals, with_arms
from doojax.experiments.trials.execution import Moves, carry_out, distances
from doojax.experiments.trials.judges import threshold_of
from doojax.experiments.trials.log import REACHED, Log, element, record_plan
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.setting import Method, Trials, TrialSettings
from doojax.experiments.trials.truth import tracking_keys, with_truth
from doojax.experiments.trials.why import explained
from doojax.keys import numbered, stream
from doojax.models.policy import Policy
from doojax.parts import in_threads
from doojax.planning import (
    Goal,
    HostDynamics,
    Plan,
    Problem,
    Rrt,
    RrtSettings,
    Tree,
    plan_of,
    search,
    shortened,
)
from doojax.planning.memory import remembered
from doojax.planning.metric import rope_sample
from doojax.planning.recovery import recovery_action
from doojax.simulation.state import SimState, Simulator
from doojax.simulation.tracking import Tracked
from doojax.tasks.base import Sampling, Task, observed
from doojax.types import Obstacles, State

CRASHED = "crashed"
NOT_EXECUTED = "the plan was not to be executed"
NOT_WANTED = "not wanted"
STUCK = "stuck, and there is no recovery"
ANYWHERE = 1e6  # m, the tolerance of a goal for which a search ends before it begins


def run_trials(
    task: Task,
    simulator: Simulator,
    method: Method,
    planning: RrtSettings,
    settings: TrialSettings,
    trials: Trials,
    *,
    keep_trees: bool = False,
    execute: bool = True,
) -> list[TrialRecord]:
    """Run R trials side by side.

    Args:
        task: what is to be done.
        simulator: where it is done.
        method: with what it is planned.
        planning: how a tree is grown.
        settings: when a trial ends.
        trials: from where to where.
        keep_trees: record all that the searches tried, not only the plans.
        execute: false to end every trial after its first search.

    Returns:
        R records; their ``replay`` holds what `replay` needs, their ``about`` counts and seconds. Where the
        simulator is a `Tracked`, they hold what was known, and whether the goal was reached in truth.
    """
    sampler = task.sample if isinstance(task, Sampling) else rope_sample
    planner = Rrt(method.dynamics, method.reliability, task, planning, sampler)
    states, goals = trials.starts, trials.goals
    obstacles = jax.vmap(simulator.obstacles)(states)
    keys = numbered(stream(trials.seed, trials.purpose), np.asarray(trials.numbers, np.uint32))
    if isinstance(simulator, Tracked):
        states = simulator.begun(states, tracking_keys(trials))
    seen = observed(simulator, states)
    logs = [Log([bodies], seen.passive) for bodies in np.asarray(seen.bodies())]
    count, nothing = seen.bodies().shape[1], nothing_of(task.actions)
    limits = np.asarray(goals.tolerance) / 2  # m, beyond which a step refutes what was predicted of it
    if method.error_threshold_m is not None:
        limits = np.full(len(logs), method.error_threshold_m)
    for log, run in zip(logs, trials.wanted or [True] * len(logs), strict=True):
        if not run:
            log.stop(NOT_WANTED)
    if method.arms is not None:
        told = refusals(method.arms, task, obstacles, seen, goals)
        for log, refused in zip(logs, told, strict=True):
            if refused and log.end is None:
                log.stop(refused)
    if method.policy is not None:
        states = _follow(task, simulator, method.policy, settings, states, goals, logs, limits, execute)
    for turn in range(0 if method.policy is not None else settings.searches + 1):
        _judge(logs, goals, seen, turn, settings)
        running = np.array([log.end is None for log in logs])
        if not running.any():
            break
        search_keys, recovery_keys = _turn_keys(keys, jnp.asarray(turn))
        begun = time.perf_counter()
        aims = eqx.tree_at(lambda g: g.tolerance, goals, jnp.where(running, goals.tolerance, ANYWHERE))
        known = [remembered(log.refuted, count) for log in logs]
        refuted = jax.tree.map(lambda *leaves: jnp.stack(leaves), *known)
        problem = Problem(obstacles, method.begin(simulator, states), aims, search_keys, refuted)
        trees = jax.tree.map(np.asarray, search(planner, problem))

        moves = [Moves(np.zeros((0, *nothing.shape), np.float32))] * len(logs)
        searched = np.flatnonzero(running).tolist()
        found = [(logs[i], planner, element((problem, trees), i), keep_trees) for i in searched]
        threads = 1 if isinstance(method.dynamics, HostDynamics) else None  # one simulator in C, one thread
        plans = in_threads(lambda one: _noted_plan(*one), found, threads)
        share = (time.perf_counter() - begun) / len(searched)
        for i, plan in zip(searched, plans, strict=True):
            logs[i].plan_s += share
            if not execute:
                logs[i].stop(NOT_EXECUTED)
            elif plan.status != "stuck":
                moves[i] = Moves(plan.actions, np.asarray(plan.states.bodies()))
                logs[i].note("execute", f"{len(plan.actions)} actions")
            elif method.recovery is None:
                logs[i].stop(STUCK)
            else:
                here = element((obstacles, seen), i)
                action = recovery_action(task, method.recovery, *here, key=recovery_keys[i])
                moves[i] = Moves(np.asarray(action)[None])
                logs[i].recoveries += 1
                logs[i].note("recover", "nothing that was tried is reliable")
        states, seen = carry_out(simulator, states, seen, goals, logs, moves, settings, limits)
    records = [
        _record(task, method, log, trials, i, *element((obstacles, trials.starts, goals), i))
        for i, log in enumerate(logs)
    ]
    return with_truth(records, simulator, states, trials) if isinstance(simulator, Tracked) else records


def crashed(
    task: Task, simulator: Simulator, method: Method, trials: Trials, error: Exception, details: str
) -> TrialRecord:
    """The record of a trial, the first of ``trials``, that an error ended: it stayed where it started."""
    true = simulator.simulator if isinstance(simulator, Tracked) else simulator
    seen = observed(true, trials.starts)
    here = element((jax.vmap(simulator.obstacles)(trials.starts), trials.starts, trials.goals), 0)
    log = Log([np.asarray(seen.bodies()[0])], seen.passive)
    log.missing = float(distances(trials.goals, seen)[0])
    log.stop(f"{CRASHED}: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}")
    record = _record(task, method, log, trials, 0, *here)
    return replace(record, about={**record.about, "traceback": details})


@jax.jit
def _turn_keys(keys: Array, turn: Int[Array, ""]) -> tuple[Array, Array]:
    split = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, turn)))(keys)
    return split[:, 0], split[:, 1]


def _judge(logs: Sequence[Log], goals: Goal, seen: State, turn: int, settings: TrialSettings) -> None:
    """End the trials that are at their goal, or have nothing left to try."""
    tolerances = np.asarray(goals.tolerance)
    for log, missing, tolerance in zip(logs, np.asarray(distances(goals, seen)), tolerances, strict=True):
        log.missing = float(missing) if np.isfinite(missing) else log.missing
        if log.end is not None:
            continue
        if missing <= tolerance:
            log.stop(REACHED)
        elif len(log.actions) >= settings.actions:
            log.stop(f"{settings.actions} actions did not suffice")
        elif turn >= settings.searches:
            log.stop(f"{settings.searches} searches did not suffice")


def _noted_plan(log: Log, planner: Rrt, found: tuple[Problem, Tree], keep_trees: bool) -> Plan:
    problem, tree = found
    plan = plan_of(tree)
    before = len(plan.actions)
    tree, plan = shortened(planner, problem, tree, plan)
    log.extensions += plan.extensions
    log.plans.append(record_plan(tree, plan, len(log.actions), whole=keep_trees))
    ends = f"{100 * plan.goal_distance:.1f} cm from the goal"
    text = f"{plan.status}, {ends}; {plan.accepted} of {plan.extensions} extensions accepted"
    if len(plan.actions) < before:
        text += f"; shortcuts left {len(plan.actions)} of {before} actions"
    log.note("plan", text)
    return plan


def _follow(
    task: Task,
    simulator: Simulator,
    policy: Policy,
    settings: TrialSettings,
    states: SimState,
    goals: Goal,
    logs: Sequence[Log],
    limits: Float[np.ndarray, "R"],
    execute: bool,
) -> SimState:
    """Have a policy act in every trial, one control period after another, if anything is to be executed; the
    last states."""
    obstacles, seen = jax.vmap(simulator.obstacles)(states), observed(simulator, states)
    for _ in range(settings.actions + 1):
        _judge(logs, goals, seen, 0, settings)
        for log in logs if not execute else []:
            log.stop(NOT_EXECUTED)
        if all(log.end is not None for log in logs):
            break
        actions = np.asarray(_acts(task, policy, obstacles, seen, goals))
        moves = [Moves(action[None]) for action in actions]
        states, seen = carry_out(simulator, states, seen, goals, logs, moves, settings, limits)
    return states


@eqx.filter_jit
def _acts(
    task: Task, policy: Policy, obstacles: Obstacles, seen: State, goals: Goal
) -> Float[Array, "R ..."]:
    def one(obstacles: Obstacles, state: State, goal: Goal) -> Array:
        return taken(task, state, policy(features(task, obstacles, state, goal)))

    return jax.vmap(one)(obstacles, seen, goals)


def _record(
    task: Task,
    method: Method,
    log: Log,
    trials: Trials,
    index: int,
    obstacles: Obstacles,
    start: SimState,
    goal: Goal,
) -> TrialRecord:
    record = log.record(task, obstacles, start, goal)
    about = {"trial": int(trials.numbers[index]), **record.about}
    about["error_threshold_m"] = method.error_threshold_m
    about["score_threshold"] = threshold_of(method.reliability)
    named = replace(record, method=method.name, seed=trials.seed, about=about)
    explained_too = replace(named, about={**about, "why": explained(named)})
    return explained_too if method.arms is None else with_arms(explained_too, method.arms)
