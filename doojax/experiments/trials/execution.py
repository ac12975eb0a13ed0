"""How trials execute actions: what is looked at after each of them, and what ends the execution."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.experiments.trials.log import REACHED, Log
from doojax.experiments.trials.setting import TrialSettings
from doojax.planning import Goal
from doojax.planning.memory import refuting
from doojax.simulation.state import Fault, SimState, Simulator
from doojax.types import State

BROKEN = int(Fault.NOT_FINITE | Fault.UNSTABLE)


class Moves(NamedTuple):
    """Actions to execute, and where all bodies (m) were predicted to be before and after, if they were."""

    actions: Float[np.ndarray, "t ..."]
    predicted: Float[np.ndarray, "t1 K 3"] | None = None


@jax.jit
def distances(goals: Goal, states: State) -> Float[Array, "R"]:
    """Of R trials, metres from the goal."""
    return jax.vmap(lambda goal, state: goal.distance(state))(goals, states)


def carry_out(
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
        missing = np.asarray(distances(goals, here))
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


def _where(mask: np.ndarray, yes: Any, no: Any) -> Any:
    def choose(a, b):
        return jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, yes, no)
