"""Random data of the tasks on every engine: ropes inside obstacles, faults, and whether engines agree."""

from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import ks_2samp

from doojax.benchmarks.physics.cases import Case, Finding, Settings
from doojax.datasets.collect import random_trajectories
from doojax.keys import numbered, stream
from doojax.tasks import make_task
from doojax.types import Trajectory

DEPTH = 0.002  # m inside an obstacle that is not counted
SHARE = 0.001  # of the states may be deeper
LIKELY = 0.01  # p-value below which two distributions count as different
SEED = 0
# trajectories and periods; MJX takes minutes for these on a CPU
SIZES = {"mujoco": (512, 20), "mjx": (64, 8), "warp": (16, 4)}


def random_data(
    settings: Settings, engine: str, sizes: dict[str, tuple[int, int]] = SIZES
) -> Iterator[Finding]:
    """Penetration in random trajectories of phase two; contact beside MuJoCo C's from the same keys.

    Trajectories part in contact, so distributions are compared, not states: two-sample Kolmogorov-Smirnov
    tests of each trajectory's last clearance, its least one, and its tail's last x, y and z (one figure of
    each trajectory, because states of one trajectory depend on each other). The smallest p-value times five
    (Bonferroni) is to be at least 0.01.
    """
    if settings.task == "default" or settings.converged:
        return
    case, (count, periods) = Case(engine, settings), sizes[engine]
    seen = random_states(settings.task, engine, count, periods)
    clearance = np.asarray(seen.clearance)[:, 1:]
    faulty = (np.asarray(seen.faults) != 0).any(1)
    tags = {"states": clearance.size}
    deep = np.nanmean(np.where(np.isfinite(clearance), clearance < -DEPTH, True))
    case = replace(case, more=tags)
    yield case.found("deeper_than_2mm", deep, 0.0, "", scale=1.0, within=SHARE)
    yield case.found("deepest", max(-np.nanmin(clearance), 0.0), 0.0, "m", scale=1.0, within=DEPTH)
    yield case.found("stretch_moving", np.nanmax(seen.stretch), 0.0, "", scale=1.0)
    yield case.found("faulty_trajectories", faulty.mean(), 0.0, "", scale=1.0, within=SHARE)
    if engine != "mujoco":
        other = random_states(settings.task, "mujoco", count, periods)
        # 1 - p: how sure it is that they differ
        p = agreement(seen, other)
        note = f"p = {p:.3g} that random data of one law differ so"
        yield case.found("unlike_mujoco", 1 - p, 0.0, "", scale=1.0, within=1 - LIKELY, note=note)


def random_states(task: str, engine: str, count: int, periods: int) -> Trajectory:
    """``count`` random trajectories of phase two."""
    the_task = make_task(task)
    keys = numbered(stream(SEED, "bench", "physics"), range(count))
    simulator = the_task.simulator(engine)
    _, _, seen = random_trajectories(the_task, simulator, keys, periods)
    return jax.tree.map(jnp.asarray, seen)


def agreement(one: Trajectory, other: Trajectory) -> float:
    """The p-value that `random_data` describes, at most 1."""
    samples = [_features(seen) for seen in (one, other)]
    tests = [ks_2samp(*pair).pvalue for pair in zip(*samples, strict=True)]  # pyright: ignore
    return min(1.0, len(tests) * float(min(tests)))


def _features(seen: Trajectory) -> list[np.ndarray]:
    clearance = np.asarray(seen.clearance)
    last = np.minimum(clearance[:, -1], 0.2)  # further away is free motion, whatever the distance
    tail = np.asarray(seen.states.points)[:, -1, 0]
    least = np.minimum(clearance[:, 1:].min(1), 0.2)
    return [last, least, *tail.T]
