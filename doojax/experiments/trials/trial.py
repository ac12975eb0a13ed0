"""Trials: plan, execute in the simulator, recover where the planner is stuck, until the goal or the end.

A trial remembers the executed steps that were not as predicted: no later search of it proposes the like.

Trials of one method run side by side, as one batch of arrays, and do not depend on one another. What ends a
trial is counted in searches and actions, so that results do not depend on the machine; the seconds that
planning took are noted beside.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from doojax.actions import nothing_of
from doojax.experiments.trials.log import REACHED as REACHED
from doojax.experiments.trials.log import Log, element, record_plan
from doojax.experiments.trials.records import TrialRecord
from doojax.keys import numbered, stream
from doojax.models.protocols import Dynamics, Recovery, Reliability
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
from doojax.planning.memory import refuting, remembered
from doojax.planning.recovery import recovery_action
from doojax.simulation.state import Fault, SimState, Simulator
from doojax.tasks.base import Task, observed
from doojax.types import Obstacles, State

CRASHED = "crashed"
NOT_EXECUTED = "the plan was not to be executed"
NOT_WANTED = "not wanted"
STUCK = "stuck, and there is no recovery"
MOST = 1_000_000  # searches or actions
BROKEN = int(Fault.NOT_FINITE | Fault.UNSTABLE)
ANYWHERE = 1e6  # m, the tolerance of a goal for which a search ends before it begins


@dataclass(frozen=True, eq=False)
class Method:
    """With what a trial is planned."""

    name: str
    dynamics: Dynamics | HostDynamics
    reliability: Reliability
    recovery: Recovery | None = None  # None: a trial that is stuck is given up
    begin: Callable[[Simulator, SimState], State] = observed  # the state that a plan starts from
    error_threshold_m: float | None = None  # of the model error, below which a prediction counts as right


@dataclass(frozen=True)
class TrialSettings:
    """When a trial ends."""

    searches: int = 10
    actions: int = 200  # executed control periods, recoveries included
    replan_distance: float | None = None  # m, RMS over points, from the plan: beyond it, execution stops

    def __post_init__(self):
        """Refuse what tries nothing."""
        for name in ("searches", "actions"):
            if not 1 <= getattr(self, name) <= MOST:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 1 to {MOST:,}")
        if self.replan_distance is not None and not self.replan_distance > 0:
            raise ValueError(f"replan_distance is {self.replan_distance}, expected a positive length (m)")


class Trials(NamedTuple):
    """R trials that run side by side."""

    starts: SimState
    goals: Goal
    numbers: Sequence[int]  # with the seed, they say what is random in each trial
    seed: int = 0
    wanted: Sequence[bool] | None = None  # by default all are; the others fill up the batch and end at once
    purpose: str = "trials"  # what for: the random stream's name


class Moves(NamedTuple):
    """Actions to execute, and where all bodies (m) were predicted to be before and after, if they were."""

    actions: Float[np.ndarray, "t ..."]
    predicted: Float[np.ndarray, "t1 K 3"] | None = None


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
        R records; their ``replay`` holds what `replay` needs, their ``about`` counts and seconds.
    """
    planner = Rrt(method.dynamics, method.reliability, task, planning)
    states, goals = trials.starts, trials.goals
    obstacles = jax.vmap(simulator.obstacles)(states)
    keys = numbered(stream(trials.seed, trials.purpose), np.asarray(trials.numbers, np.uint32))
    seen = observed(simulator, states)
    logs = [Log([bodies], seen.passive) for bodies in np.asarray(seen.bodies())]
    count, nothing = seen.bodies().shape[1], nothing_of(task.actions)
    limits = np.asarray(goals.tolerance) / 2  # m, beyond which a step refutes what was predicted of it
    if method.error_threshold_m is not None:
        limits = np.full(len(logs), method.error_threshold_m)
    for log, run in zip(logs, trials.wanted or [True] * len(logs), strict=True):
        if not run:
            log.stop(NOT_WANTED)
    for turn in range(settings.searches + 1):
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
        states, seen = _execute(simulator, states, seen, goals, logs, moves, settings, limits)
    return [
        _record(task, method, log, trials, i, *element((obstacles, trials.starts, goals), i))
        for i, log in enumerate(logs)
    ]


def crashed(
    task: Task, simulator: Simulator, method: Method, trials: Trials, error: Exception, details: str
) -> TrialRecord:
    """The record of a trial, the first of ``trials``, that an error ended: it stayed where it started."""
    seen = observed(simulator, trials.starts)
    here = element((jax.vmap(simulator.obstacles)(trials.starts), trials.starts, trials.goals), 0)
    log = Log([np.asarray(seen.bodies()[0])], seen.passive)
    log.missing = float(_distances(trials.goals, seen)[0])
    log.stop(f"{CRASHED}: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}")
    record = _record(task, method, log, trials, 0, *here)
    return replace(record, about={**record.about, "traceback": details})


@jax.jit
def _turn_keys(keys: Array, turn: Int[Array, ""]) -> tuple[Array, Array]:
    split = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, turn)))(keys)
    return split[:, 0], split[:, 1]


@jax.jit
def _distances(goals: Goal, states: State) -> Float[Array, "R"]:
    return jax.vmap(lambda goal, state: goal.distance(state))(goals, states)


def _judge(logs: Sequence[Log], goals: Goal, seen: State, turn: int, settings: TrialSettings) -> None:
    """End the trials that are at their goal, or have nothing left to try."""
    tolerances = np.asarray(goals.tolerance)
    for log, missing, tolerance in zip(logs, np.asarray(_distances(goals, seen)), tolerances, strict=True):
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


def _execute(
    simulator: Simulator,
    states: SimState,
    seen: State,
    goals: Goal,
    logs: Sequence[Log],
    moves: Sequence[Moves],
    settings: TrialSettings,
    limits: Float[np.ndarray, "R"],
) -> tuple[SimState, State]:
    """Execute every trial's actions until its goal is reached, one control period of all trials at a time."""
    tolerances = np.asarray(goals.tolerance)
    left = [len(move.actions) for move in moves]
    for step in range(max(left)):
        actions = np.zeros((len(logs), *moves[0].actions.shape[1:]), np.float32)
        moving = np.zeros(len(logs), dtype=bool)
        for i, log in enumerate(logs):
            if log.end is None and step < left[i] and len(log.actions) < settings.actions:
                actions[i], moving[i] = moves[i].actions[step], True
        if not moving.any():
            break
        last, trajectory = simulator.rollout(states, jnp.asarray(actions)[:, None])
        here = jax.tree.map(lambda leaf: leaf[:, -1], trajectory.states)
        broken = (np.asarray(trajectory.faults)[:, -1] & BROKEN) != 0
        # of a trial that breaks the last sound state stays: it says how far the goal was
        states, seen = _where(moving & ~broken, (last, here), (states, seen))
        bodies = np.asarray(here.bodies())
        missing = np.asarray(_distances(goals, here))
        for i in np.flatnonzero(moving).tolist():
            log, predicted = logs[i], moves[i].predicted
            before, after = log.bodies[-1], bodies[i]
            log.actions.append(actions[i])
            log.bodies.append(after)
            if broken[i]:
                log.stop("the simulation became unstable")
                continue
            if predicted is not None:
                outcome = refuting(before, after, predicted[step : step + 2], float(limits[i]))
                log.refuted += [outcome] if outcome else []
            if missing[i] <= tolerances[i]:
                log.missing = float(missing[i])
                log.stop(REACHED)
            elif predicted is not None and settings.replan_distance is not None:
                gaps = (after - predicted[step + 1])[: log.passive]
                off = float(np.sqrt((gaps**2).sum(-1).mean()))
                if off > settings.replan_distance and step + 1 < left[i]:
                    left[i] = 0
                    log.note("replan", f"{100 * off:.1f} cm from where the plan had the rope")
    return states, seen


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
    return replace(record, method=method.name, seed=trials.seed, about=about)


def _where(mask: np.ndarray, yes: Any, no: Any) -> Any:
    def choose(a, b):
        return jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, yes, no)
