"""How fast signatures are computed, one at a time and in batches, beside the h-signature package.

The scene is threading (`doojax/topology/threading.json`): a cable, plugged in at one end, runs through three
fixtures; a left gripper holds it behind them and a right one between the first two, which makes two grasp
loops. In a second variant the left gripper holds it alone, which makes one: the package then has half the
work, while the shapes, and so the time, of a jitted function stay the same.

Base, arms, path to the plug and cable have 58 segments, the skeleton has 12: 696 pairs, at about 130
additions and multiplications each. On two cores with vectors of eight numbers these 0.1 million operations
take about a microsecond at best. Memory is no limit beside that: 0.7 kB are read and 33 bytes written. A
single signature takes what JAX needs to hand the work to its threads and back.
"""

import json as json_format
import time
from collections.abc import Callable
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from doojax import topology
from doojax.benchmarks.medians import median_with_interval
from doojax.benchmarks.stages import stages
from doojax.commands import command_line
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row
from doojax.keys import stream
from doojax.terminal import labelled, narrow_table
from doojax.topology.describe import THREADING, Scene, read_scene

SEED = 0
BATCH = 1024
ROUNDS = 40
JITTER = 0.001  # standard deviation of the points of a batch's states, metres


def signature(*, json: bool = False, publish: Path | None = None) -> None:
    """Measure how long a signature takes, beside the h-signature package.

    One signature is timed from NumPy arrays to a tuple of Python integers, a batch of 1,024 from arrays on
    the device to arrays on the device. The package is given ready-made loops, and its function alone is
    timed. All take turns, so that they meet the same load.

    Args:
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/topology; by
            default they are only shown.

    Raises:
        ModuleNotFoundError: the package is not installed; `pip install 'doojax[bench]'` does that.
    """
    command = command_line(signature, locals())
    variants = [(name, (name, scene)) for name, scene in scenes().items()]
    rows = [one for name, scene in stages("signatures", variants) for one in measure(name, scene)]
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    if json:
        print(json_format.dumps([asdict(row) for row in rows], indent=1))
        return
    table = narrow_table("scene, implementation", "batch", "μs per signature", "times faster")
    faster = {tuple(one.tags.values()): one.value for one in rows if one.metric == "speedup"}
    for entry in (one for one in rows if one.metric == "us_per_signature"):
        scene, implementation, batch = (str(tag) for tag in entry.tags.values())
        ratio = faster.get((scene, implementation, int(batch)))
        table.add_row(
            labelled(scene, implementation), batch, f"{entry.value:.4g}", f"{ratio:.4g}" if ratio else ""
        )
    Console().print(table)


def scenes() -> dict[str, Scene]:
    """The variants that are measured."""
    both = read_scene(THREADING)
    left = eqx.tree_at(lambda scene: scene.grasps.gripping, both, jnp.array([True, False]))
    return {"threading": both, "threading, one gripper": left}


def measure(name: str, scene: Scene) -> list[Row]:
    """Time the implementations in turns.

    Raises:
        RuntimeError: they disagree about the scene's signature.
    """
    run_one, run_batch = jax.jit(topology.signature), jax.jit(jax.vmap(topology.signature, (0, None)))
    state, states = jax.tree.map(np.asarray, scene.grasps), jittered(scene)
    released, released_name = released_signature(scene)

    def one() -> tuple[tuple[int, ...], ...]:
        return run_one(state, scene.skeleton).vectors

    def batch() -> topology.Signature:
        return jax.block_until_ready(run_batch(states, scene.skeleton))

    expected = one()
    if released() != expected or not (np.asarray(batch().rows) == run_one(state, scene.skeleton).rows).all():
        raise RuntimeError(f"{name}: doojax finds {expected}, h-signature {released()}, or the batch differs")

    # Calls are repeated within a round such that each implementation gets some ten milliseconds.
    runs = {(released_name, 1): (released, 5), ("doojax", 1): (one, 50), ("doojax", BATCH): (batch, 5)}
    seconds = take_turns(list(runs.values()))
    rows, medians = [], []
    for ((implementation, size), _), samples in zip(runs.items(), seconds, strict=True):
        median, low, high = (1e6 * value / size for value in median_with_interval(samples))
        tags = {"scene": name, "implementation": implementation, "batch": size}
        rows.append(row("us_per_signature", tags, median, "us", low, high, len(samples)))
        medians.append(median)
        if implementation == "doojax":
            rows.append(row("speedup", tags, medians[0] / median, ""))
    return rows


def jittered(scene: Scene) -> topology.Grasps:
    """A batch of states around a scene's; their points move by about a millimetre."""

    def spread(leaf: jax.Array, key: jax.Array) -> jax.Array:
        copies = jnp.broadcast_to(leaf, (BATCH, *leaf.shape))
        is_points = leaf.ndim > 1
        return copies + JITTER * jax.random.normal(key, copies.shape) if is_points else copies

    leaves, structure = jax.tree.flatten(scene.grasps)
    keys = jax.random.split(stream(SEED, "bench", "signature"), len(leaves))
    return jax.tree.unflatten(structure, map(spread, leaves, keys))


def released_signature(scene: Scene) -> tuple[Callable[[], tuple[tuple[int, ...], ...]], str]:
    """The same signature by the h-signature package, loops in advance; and the package's name and version."""
    from h_signature.h_signature_np import get_h_signature  # pyright: ignore[reportMissingImports]

    loops = topology.loops_of(scene.grasps)
    paths = [without_padding(path) for path in np.asarray(loops.points[loops.active], float)]
    skeleton = {
        name: without_padding(np.asarray(loop, float))
        for name, loop in zip(scene.skeleton.names, scene.skeleton.loops, strict=True)
    }

    def compute() -> tuple[tuple[int, ...], ...]:
        return tuple(sorted((get_h_signature(path, skeleton) for path in paths), reverse=True))

    return compute, f"h-signature {metadata.version('h-signature')}"


def without_padding(points: np.ndarray) -> np.ndarray:
    """A polyline without the points that repeat the one before."""
    return points[np.append(True, (points[1:] != points[:-1]).any(axis=1))]


def take_turns(functions: list[tuple[Callable[[], Any], int]]) -> list[np.ndarray]:
    """Seconds of each call: in every round, each function is called as often as it says."""
    seconds: list[list[float]] = [[] for _ in functions]
    for _ in range(ROUNDS):
        for (function, times), samples in zip(functions, seconds, strict=True):
            for _ in range(times):
                start = time.perf_counter()
                function()
                samples.append(time.perf_counter() - start)
    return [np.array(samples) for samples in seconds]
