"""How soon a recovery frees ropes that are stuck, beside random actions, in the simulator."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from doojax.datasets.replay import stored_starts
from doojax.datasets.store import Dataset
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import success_rate
from doojax.experiments.reports.summary import row
from doojax.keys import generator, stream
from doojax.learning.data import Trajectories
from doojax.learning.recovery import acceptances
from doojax.models.protocols import Dynamics, Recovery, Reliability
from doojax.planning.recovery import RandomRecovery, recovery_action
from doojax.simulation.state import SimState
from doojax.tasks.ropes import task_of

MOST_STATES, MOST_ACTIONS = 256, 10
DRAWS = 2000  # of the bootstrap


def recovery_rows(
    dataset: Dataset,
    test: Trajectories,
    dynamics: Dynamics,
    classifier: Reliability,
    recovery: Recovery,
    tags: dict[str, Any],
    seed: int,
) -> list[Row]:
    """Fractions of stuck ropes that are free after one action and after ten, and their ratio to random ones.

    One stuck state a trajectory of the test split, the first: where none of 32 sampled actions is accepted.

    Raises:
        ValueError: no state of the test split is stuck.
    """
    task = task_of(dataset.config)
    find_key, check_key, act_key = (
        stream(seed, "recovery trials", name) for name in ("find", "check", "act")
    )
    accepted = acceptances(task, dynamics, classifier, test.obstacles, test.states, key=find_key)
    stuck = np.asarray(accepted)[:, :-1] == 0
    rows = np.flatnonzero(stuck.any(1))[:MOST_STATES]
    if not len(rows):
        raise ValueError(f"{dataset.path}: no state of the test split is stuck, so there is nothing to free")
    times = stuck[rows].argmax(1)
    simulator = task.simulator(dataset.config["engine"])
    actions = np.asarray(test.actions)[rows]
    starts = stored_starts(dataset, np.asarray(test.rows)[rows])
    states = _states_at(simulator, starts, actions, times)
    result = [row("stuck_fraction", tags, stuck.mean(), "", n=stuck.size)]
    freed = {}
    for name, judge in (("learned", recovery), ("random", RandomRecovery())):
        freed[name] = _actions_until_free(
            task, simulator, dynamics, classifier, judge, states, keys=(check_key, act_key)
        )
        for most in (1, MOST_ACTIONS):
            free = success_rate(freed[name] <= most)
            label = tags | {"policy": name, "actions": most}
            result.append(row("unstuck_probability", label, free.value, "", free.low, free.high, free.n))
        spent = np.minimum(freed[name], MOST_ACTIONS)
        result.append(row("actions_until_unstuck", tags | {"policy": name}, spent.mean(), "", n=len(spent)))
    ratio = _ratio_interval(freed["learned"] <= 1, freed["random"] <= 1, seed)
    result.append(row("unstuck_ratio", tags | {"against": "random"}, *ratio, len(rows)))
    return result


def _states_at(simulator: Any, states: SimState, actions: np.ndarray, times: np.ndarray) -> SimState:
    """Each of B simulations at its own time."""
    found = states
    for time in range(int(times.max())):
        states, _ = simulator.rollout(states, jnp.asarray(actions[:, time : time + 1]))
        here = times == time + 1
        found = jax.tree.map(
            lambda new, old, h=here: jnp.where(h.reshape(-1, *[1] * (new.ndim - 1)), new, old), states, found
        )
    return found


def _actions_until_free(
    task: Any,
    simulator: Any,
    dynamics: Dynamics,
    classifier: Reliability,
    recovery: Recovery,
    states: SimState,
    *,
    keys: tuple[jax.Array, jax.Array],
) -> Int[np.ndarray, "B"]:
    """How many recovery actions each rope takes until some action is accepted; 11 for more than ten."""
    obstacles = jax.vmap(simulator.obstacles)(states)
    count = len(states.qpos)
    act = jax.vmap(lambda scene, rope, key: recovery_action(task, recovery, scene, rope, key=key))
    needed = np.full(count, MOST_ACTIONS + 1)
    for number in range(1, MOST_ACTIONS + 1):
        rope = simulator.observations(states).state
        act_keys = jax.random.split(jax.random.fold_in(keys[1], number), count)
        states, seen = simulator.rollout(states, act(obstacles, rope, act_keys)[:, None])
        after = jax.tree.map(lambda leaf: leaf[:, -1:], seen.states)
        check = jax.random.fold_in(keys[0], number)
        free = np.asarray(acceptances(task, dynamics, classifier, obstacles, after, key=check))[:, 0] > 0
        needed = np.where(free & (needed > MOST_ACTIONS), number, needed)
    return needed


def _ratio_interval(
    first: Bool[np.ndarray, "B"], second: Bool[np.ndarray, "B"], seed: int
) -> tuple[float, str, float | None, float | None]:
    """The ratio of two fractions over the same states with its bootstrap interval, and no unit."""
    drawn = generator(seed, "recovery trials", "bootstrap").integers(len(first), size=(DRAWS, len(first)))
    below = second[drawn].mean(1)
    ratio = float(first.mean() / max(second.mean(), 1 / len(second)))
    if (below == 0).any():
        return ratio, "", None, None
    low, high = np.quantile(first[drawn].mean(1) / below, [0.025, 0.975])
    return ratio, "", float(low), float(high)
