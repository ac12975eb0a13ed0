"""How fast the dynamics ensemble is trained, beside the same network, loss and optimiser in flax.

Arithmetic: rolling out a trajectory of T actions and going back through it takes 6 T operations a weight. The
thesis's network has 1.1 million weights: a batch of 16 with T = 9 needs 1 GFLOP a step and member, some 20 ms
on two cores at 50 GFLOP/s; Adam reads and writes 30 MB, some 3 ms. Nothing of this is shared among members,
so that 8 of them on a CPU cost 8 times as much as one, at best. A GPU is idle most of the time with one.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from doojax.benchmarks.medians import median_row
from doojax.benchmarks.stages import stages
from doojax.commands import command_line
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, show
from doojax.keys import stream
from doojax.learning.data import Trajectories
from doojax.learning.fit import FitConfig, epoch, start
from doojax.learning.losses import DynamicsProblem
from doojax.learning.presets import PresetName, dynamics_preset
from doojax.simulation.scenes import obstacles_at, parked_poses
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.types import RopeState

SEED = 0
MEMBERS = 8
ROUNDS = 11
STEPS = {"thesis": 16, "quick": 64}  # of an epoch
WANDER = 0.02  # standard deviation of a point's motion in one step, m


def training(*, task: str = "rope_dragging", json: bool = False, publish: Path | None = None) -> None:
    """Measure train steps per second with 1 and 8 members, and in flax.

    Ours are whole epochs as `doojax train` runs them, validation on a few trajectories and the choice of the
    best weights included; flax's are the steps alone. All take turns, on random data of the task's shapes.
    A step of 8 members trains all of them.

    Args:
        task: rope_dragging or dual_gripper: whose shapes.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/where_to_trust; by
            default they are only shown.

    Raises:
        ModuleNotFoundError: flax is not installed; `pip install 'doojax[bench]'` does that.
        ValueError: for an unknown task.
    """
    command = command_line(training, locals())
    the_task = make_task(task, phase="unconstrained")
    presets = [(preset, preset) for preset in get_args(PresetName)]
    rows = [one for preset in stages(f"{task}, preset", presets) for one in measure(the_task, preset)]
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    show(rows, json)


def measure(task: Task, preset: PresetName) -> list[Row]:
    """Rates and ratios for one preset's network, batch size and learning rate."""
    chosen = dynamics_preset(preset, task)
    steps = STEPS[preset]
    periods = task.trajectory_states - 1
    train = random_trajectories(
        task, steps * chosen.fit.batch_size, periods, key=stream(SEED, "bench", "trajectories")
    )
    few = jax.tree.map(lambda leaf: leaf[:4], train)
    problem = DynamicsProblem(train, few, chosen.network, preset != "thesis")

    def config(members: int) -> FitConfig:
        return FitConfig(
            epochs=1 + ROUNDS,
            batch_size=chosen.fit.batch_size,
            members=members,
            learning_rate=chosen.fit.learning_rate,
            schedule=chosen.fit.schedule,
        )

    seconds = take_turns(
        {
            "one": our_epochs(problem, config(1)),
            "all": our_epochs(problem, config(MEMBERS)),
            "flax": flax_epochs(problem, config(1)),
        }
    )
    tags = {"task": task.name, "model": "dynamics", "preset": preset}
    rows = []
    for name, members, library in (("one", 1, "doojax"), ("all", MEMBERS, "doojax"), ("flax", 1, "flax")):
        own = tags | {"members": members, "library": library}
        rows.append(median_row("train_steps_per_s", own, steps / seconds[name], "1/s"))
    for metric, about, ratio in (
        ("ensemble_cost_ratio", {"members": MEMBERS}, seconds["all"] / seconds["one"]),
        ("throughput_ratio", {"against": "flax"}, seconds["flax"] / seconds["one"]),
    ):
        rows.append(median_row(metric, tags | about, ratio, ""))
    return rows


def random_trajectories(task: Task, count: int, periods: int, *, key: Array) -> Trajectories:
    """``count`` ropes whose points, and the grippers that ``periods`` actions move, wander about."""
    links, grippers = task.scene.links, task.grippers
    keys = jax.random.split(key, 3)
    first = 0.2 * jax.random.normal(keys[0], (count, 1, links + grippers, 3))
    moves = WANDER * jax.random.normal(keys[1], (count, periods, links + grippers, 3))
    points = jnp.concatenate([first, first + jnp.cumsum(moves, axis=1)], axis=1)
    obstacles = obstacles_at(task.scene, *parked_poses(len(task.scene.obstacles)))
    return Trajectories(
        states=RopeState(points[:, :, :links], points[:, :, links:]),
        actions=moves[:, :, links:],
        obstacles=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), obstacles),
        rows=jnp.arange(count),
    )


def our_epochs(problem: DynamicsProblem, config: FitConfig) -> Callable[[int], None]:
    """A function that trains one epoch, given its number, from 1, as `doojax.learning.fit.fit` does."""
    key = stream(SEED, "bench", "training")
    state, static = start(problem, config, None, key=key)

    def run(number: int) -> None:
        nonlocal state
        keys = jax.random.split(jax.random.fold_in(key, number), config.members)
        settings = (problem, static, None, keys, config)
        state, measured = epoch(settings, state)
        jax.block_until_ready((state, measured))

    return run


def flax_epochs(problem: DynamicsProblem, config: FitConfig) -> Callable[[int], None]:
    """The same in flax, step by step, without validation."""
    from doojax.benchmarks.flax_peer import peer_state, peer_step

    key = stream(SEED, "bench", "training")
    steps = len(problem.trajectories) // config.batch_size
    rate: float | optax.Schedule = config.learning_rate
    if config.schedule != "constant":
        rate = optax.cosine_decay_schedule(config.learning_rate, config.epochs * steps)
    state, constants = peer_state(problem.init(None, key=jax.random.fold_in(key, 0)), rate)

    def run(number: int) -> None:
        nonlocal state
        epoch_key = jax.random.fold_in(key, number)
        for rows in problem.batches(None, config.batch_size, key=epoch_key):
            state, _ = peer_step(state, constants, problem.trajectories, rows)
        jax.block_until_ready(state.params)

    return run


def take_turns(runs: Mapping[str, Callable[[int], None]]) -> dict[str, np.ndarray]:
    """Seconds of each run's epochs, taking turns; without the first, which compiles."""
    for run in runs.values():
        run(1)
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for number in range(2, 2 + ROUNDS):
        for name, run in runs.items():
            begun = time.perf_counter()
            run(number)
            seconds[name].append(time.perf_counter() - begun)
    return {name: np.array(values) for name, values in seconds.items()}
