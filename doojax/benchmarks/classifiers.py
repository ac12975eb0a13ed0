"""How long a transition's judgement takes: from distances, beside the thesis's classifier from voxels.

Arithmetic, for `rope_dragging` and the thesis's sizes. From voxels: two states, each 40,000 voxels of three
channels; three convolutions of 9 x 3 x 26, 9 x 26 x 26 and 9 x 26 x 26 multiplications at 38,416, 8,836 and
1,764 places: 370 MFLOP, so that two cores at 100 GFLOP/s need 4 ms. From distances: at 21 points of the chain
the distances to a handful of primitives at three moments, and 101,000 weights: 4 MFLOP, 0.04 ms.

Weights are as they are before training: how long a network takes does not depend on what it has learned.
"""

import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from doojax.benchmarks.medians import median_row
from doojax.benchmarks.stages import stages
from doojax.commands import command_line
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.keys import stream
from doojax.learning.presets import PresetName, classifier_preset, voxel_classifier_preset
from doojax.models.classifier import DistanceClassifier
from doojax.models.voxel_classifier import VoxelClassifier
from doojax.simulation.state import SimState
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.types import Obstacles, RopeState, Transition

SEED = 0
ROUNDS = 9
AT_LEAST = 0.1  # s, of one timing
KINDS = {
    "classifier": (DistanceClassifier, classifier_preset, (64, 256, 1024)),
    "voxel_classifier": (VoxelClassifier, voxel_classifier_preset, (1, 8, 32)),
}
"""Network, its sizes, and the batches that are tried: more than these fit no cache."""
Name = tuple[str, str, int]
"""Preset, kind and batch."""
PAIRS = (("thesis", "thesis"), ("quick", "quick"), ("quick", "thesis"))
"""Presets of the classifier from distances and of the one from voxels whose speeds are compared: like with
like, and what planning uses by default with what the thesis used."""


def classifiers(
    *,
    tasks: tuple[str, ...] = ("rope_dragging", "dual_gripper"),
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Measure microseconds per judged transition of both classifiers.

    Each is run on batches of several sizes, of which the best counts. All take turns.

    Args:
        tasks: whose scenes and ropes.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/where_to_trust; by
            default they are only shown.

    Raises:
        ValueError: for an unknown task.
    """
    command = command_line(classifiers, locals())
    rows: list[Row] = []
    for task in stages("classifiers", [(name, make_task(name)) for name in tasks]):
        examples = drawn(task, max(KINDS["classifier"][2]), key=stream(SEED, "bench", "classifiers"))
        rows += rows_of(task.name, take_turns(runs_of(task, *examples)))
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    show(rows, json)


def drawn(task: Task, count: int, *, key: Array) -> tuple[Obstacles, Transition]:
    """``count`` scenes of the task, and in each a rope that moves as its grippers do on average."""
    simulator = task.simulator("mujoco")
    start_key, action_key = jax.random.split(key)
    starts: SimState = jax.jit(jax.vmap(simulator.reset))(jax.random.split(start_key, count))
    state: RopeState = simulator.observations(starts).state
    actions = jax.vmap(task.actions.draw)(jax.random.split(action_key, count))
    after = RopeState(state.points + actions.mean(1, keepdims=True), state.grippers + actions)
    return jax.vmap(simulator.obstacles)(starts), Transition(state, actions, after, jnp.full(count, 0.01))


def runs_of(task: Task, obstacles: Obstacles, transitions: Transition) -> dict[Name, Callable[[], Any]]:
    """What is timed: functions that judge a batch and wait."""
    runs = {}
    for preset, (kind, (network, preset_of, batches)) in product(get_args(PresetName), KINDS.items()):
        model = network(preset_of(preset, task).network, key=stream(SEED, "bench", "network"))
        for batch in batches:
            part = jax.tree.map(lambda leaf, b=batch: leaf[:b], (obstacles, transitions))
            runs[preset, kind, batch] = partial(_judge_and_wait, model, *part)
    return runs


def take_turns(runs: Mapping[Name, Callable[[], Any]]) -> dict[Name, np.ndarray]:
    """Seconds per transition, a figure a round; calls that are short are repeated within it."""
    repeats = {}
    for name, run in runs.items():
        run()  # compiles
        begun = time.perf_counter()
        run()
        repeats[name] = max(1, round(AT_LEAST / (time.perf_counter() - begun)))
    seconds: dict[Name, list[float]] = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, run in runs.items():
            begun = time.perf_counter()
            for _ in range(repeats[name]):
                run()
            seconds[name].append((time.perf_counter() - begun) / repeats[name] / name[2])
    return {name: np.array(values) for name, values in seconds.items()}


def rows_of(task: str, seconds: Mapping[Name, np.ndarray]) -> list[Row]:
    """Each one's best batch, and how many times faster the one from distances is."""
    rows, best = [], {}
    for preset, kind in product(get_args(PresetName), KINDS):
        batches = [name[2] for name in seconds if name[:2] == (preset, kind)]
        batch = min(batches, key=lambda batch: np.median(seconds[preset, kind, batch]))
        best[preset, kind] = seconds[preset, kind, batch]
        tags = {"task": task, "model": kind, "preset": preset}
        rows.append(median_row("classifier_us_per_transition", tags, 1e6 * best[preset, kind], "us"))
        rows.append(row("classifier_best_batch", tags, batch, ""))
    for ours, theirs in PAIRS:
        ratio = best[theirs, "voxel_classifier"] / best[ours, "classifier"]
        tags = {"task": task, "preset": ours, "voxel_preset": theirs}
        rows.append(median_row("classifier_speedup", tags, ratio, ""))
    return rows


@eqx.filter_jit
def _judge(model: Any, obstacles: Obstacles, batch: Transition) -> Array:
    return jax.vmap(model)(obstacles, batch).score


def _judge_and_wait(model: Any, obstacles: Obstacles, batch: Transition) -> Array:
    return jax.block_until_ready(_judge(model, obstacles, batch))
