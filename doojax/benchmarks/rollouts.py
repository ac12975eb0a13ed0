"""How fast each engine simulates a task, in one run, free and in contact, beside bare `mujoco.rollout`.

Arithmetic and bytes, for `rope_dragging` (15 degrees of freedom, up to 48 contact rows, 30 friction rows): a
Newton iteration builds and factors a 15 x 15 matrix from 80 rows, 2 x 80 x 15^2 / 2 operations and some, and
a step has one to six of them: some 0.1 million operations, 5 microseconds of one core at 20 GFLOP/s. MuJoCo C
needs six times that, in cache. MJX holds every intermediate of a whole batch, some 60 kB an element: 1,024
would stream 60 MB through memory several times a step, so on a CPU they are simulated in parts of 16, one a
processor.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from doojax.benchmarks.stages import stages
from doojax.commands import command_line
from doojax.datasets.collect import random_trajectories
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.keys import numbered, stream
from doojax.parts import processors
from doojax.simulation.engines import available_engines, resolve_engine
from doojax.simulation.engines.bare import bare_rollout
from doojax.simulation.state import SimState, Simulator
from doojax.tasks import make_task
from doojax.tasks.base import Task

SEED = 0
SAMPLES, PERIODS = 256, 10  # trajectories, and actions in each, that the states in contact are taken from
TOUCHING = 0.002  # m between rope and obstacle, less counts as contact
ROUNDS = 3
BARE = "mujoco.rollout"
MOST_ON_C = 1024  # elements: beyond, MuJoCo C's rate no longer depends on the batch


def rollouts(
    *,
    task: str = "rope_dragging",
    batches: tuple[int, ...] = (64, 1024),
    engines: tuple[str, ...] = (),
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Measure physics steps and transitions per second of every engine: minutes on two cores, most for MJX.

    The engines take turns. Warp runs on a CPU for the smallest batch only: there it is made for testing.

    Args:
        task: rope_dragging or dual_gripper.
        batches: numbers of elements.
        engines: some of mujoco, mjx and warp; all that this machine has by default.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/simulation; by
            default they are only shown.

    Raises:
        ValueError: for an unknown task or engine, or a batch below 1.
        ModuleNotFoundError: for an engine that is not installed.
    """
    command = command_line(rollouts, locals())
    the_task = make_task(task)
    engines = tuple(map(resolve_engine, engines or available_engines()))
    if min(batches, default=0) < 1:
        raise ValueError(f"batches are {batches}, expected one or more numbers of at least 1")
    rows, compile_s, sampled = [], {}, {}
    parts = [
        (f"{batch} states {'in contact' if contact else 'in free motion'}", (contact, batch))
        for contact in (False, True)
        for batch in batches
    ]
    for contact, batch in stages(f"{task} on {', '.join(engines)}", parts):
        if contact not in sampled:
            sampled[contact] = sampled_states(the_task, contact, max(batches))
        part = jax.tree.map(lambda leaf, b=batch: leaf[:b], sampled[contact])
        rates = measure(the_task, engines, *part, slow_engines=batch == min(batches), compiled=compile_s)
        tags = {"task": task, "batch": batch, "contact": contact}
        for engine, samples in rates.items():
            best, worst = max(samples), min(samples)
            per = the_task.scene.substeps
            own = tags | {"engine": engine}
            rows.append(row("steps_per_s", own, best, "1/s", worst, best, len(samples)))
            rows.append(row("transitions_per_s", own, best / per, "1/s", worst / per, best / per))
        if "mjx" in rates:
            rows.append(row("mjx_over_mujoco", tags, max(rates["mjx"]) / max(rates[BARE]), ""))
        if "mujoco" in rates:
            rows.append(row("bare_over_mujoco", tags, max(rates[BARE]) / max(rates["mujoco"]), ""))
    rows += [row("compile_s", {"task": task, "engine": e}, s, "s") for e, s in compile_s.items()]
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    show(rows, json)


def sampled_states(task: Task, contact: bool, count: int) -> tuple[SimState, jax.Array]:
    """``count`` states of random trajectories, free or in contact, and the action that led to each.

    Free states are those of phase one. States in contact are the last ones of phase two in which the rope or
    a gripper is within 2 mm of an obstacle; repeated where there are fewer than ``count``.

    Raises:
        RuntimeError: if none of the random trajectories ends in contact.
    """
    task = make_task(task.name, phase="constrained" if contact else "unconstrained")
    simulator = task.simulator("mujoco")
    keys = numbered(stream(SEED, "bench", "rollouts"), range(SAMPLES))
    _, last, seen = random_trajectories(task, simulator, keys, PERIODS)
    wanted = np.asarray(seen.clearance[:, -1]) < TOUCHING if contact else np.ones(SAMPLES, dtype=bool)
    if not wanted.any():
        raise RuntimeError(f"no random trajectory of {task.name} ended in contact")
    chosen = np.resize(np.flatnonzero(wanted), count)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[chosen], (last, seen.actions[:, -1]))


def measure(
    task: Task,
    engines: tuple[str, ...],
    states: SimState,
    actions: jax.Array,
    slow_engines: bool,
    compiled: dict[str, float],
) -> dict[str, list[float]]:
    """Physics steps per second of each engine in each round; also notes how long each took to compile."""
    threads = processors()
    batch = actions.shape[0]
    few_states, few_actions = jax.tree.map(lambda leaf: leaf[:MOST_ON_C], (states, actions))
    runs: dict[str, Callable[[], Any]] = {BARE: bare_rollout(task.scene, few_states, few_actions, threads)}
    for engine in engines:
        if engine == "warp" and jax.default_backend() == "cpu" and not slow_engines:
            continue
        own = (few_states, few_actions) if engine == "mujoco" else (states, actions)
        runs[engine] = period(task.simulator(engine), *own)
    first = {engine: seconds(run) for engine, run in runs.items()}
    on_c = (BARE, "mujoco")
    steps = {e: (min(batch, MOST_ON_C) if e in on_c else batch) * task.scene.substeps for e in runs}
    rates = {engine: [] for engine in runs}
    for _ in range(ROUNDS):
        for engine, run in runs.items():
            rates[engine].append(steps[engine] / seconds(run))
    for engine in first.keys() - {BARE}:
        compiled.setdefault(engine, max(first[engine] - steps[engine] / max(rates[engine]), 0.0))
    return rates


def period(simulator: Simulator, states: SimState, actions: jax.Array) -> Callable[[], Any]:
    """A function that simulates one control period and waits for it."""
    return lambda: jax.block_until_ready(simulator.rollout(states, actions[:, None]))


def seconds(run: Callable[[], Any]) -> float:
    """How long one call takes."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start
