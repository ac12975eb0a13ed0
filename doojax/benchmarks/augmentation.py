"""Are augmentations what the simulator would do? And how many come in a second.

Of ropes, transitions are drawn in the middle of random trajectories, so that they lie against obstacles; of
pushing, examples are whole trajectories. Each is moved as the augmentation says, start and actions included,
and simulated on MuJoCo C: the error is the distance (root mean square over the rope's points, or over bodies
and hand) between where the simulator ends and the augmented outcome. Beside it stand

- ``original``: the example itself, simulated again from a start that lies a tenth of a millimetre aside
  (moved rigidly), as far as "touches or not" means anything. Simulated again from the very same start it
  comes out the same to the last bit;
- ``random``: the same drawn transforms, without the projection.

What is looked at apart: examples that touch an obstacle, where the moved one touches as the original does but
with another depth and another normal, and those that do not.
"""

import time
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from doojax.augmentation import Augmented, Examples, Setting, augment, setting_of, usual
from doojax.augmentation.resimulation import drawn_examples, resimulation_errors
from doojax.benchmarks.stages import stages
from doojax.commands import command_line
from doojax.datasets.diversity import divergence, nearest_distances
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.keys import numbered, stream
from doojax.simulation.state import SimState, Simulator
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.types import Verdict

ASIDE = 1e-4  # m, of a start that counts as the same
QUANTILES = (0.5, 0.9)
TIMES = 2.0  # the simulator's own error, within which an augmentation's should be
SAME = 1e-6  # m: what is nearer is the same; coordinates of a metre in float32 are 1.2e-7 apart
ROUNDS = 3


def augmentation(
    *,
    tasks: tuple[str, ...] = ("rope_dragging", "dual_gripper", "planar_pushing"),
    transitions: int = 64,
    seed: int = 0,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Measure the error, acceptance and speed of augmentations.

    Args:
        tasks: of which.
        transitions: how many examples of each task, each with one augmentation.
        seed: of transitions and transforms.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures; by default they are only shown.

    Raises:
        ValueError: for an unknown task or a count below 1.
    """
    command = command_line(augmentation, locals())
    if transitions < 1:
        raise ValueError(f"transitions is {transitions}, expected at least 1")
    rows: list[Row] = []
    for task in stages("augment", [(name, make_task(name)) for name in tasks]):
        rows += measured(task, transitions, seed)
    publish_rows(publish, command=command, seed=seed, rows=rows)
    show(rows, json)


def measured(task: Task, count: int, seed: int) -> list[Row]:
    """All rows of one task."""
    simulator = task.simulator("mujoco")
    start_key, action_key = (stream(seed, "bench", "augment", name) for name in ("starts", "actions"))
    starts, examples = drawn_examples(task, simulator, count, start_key, action_key)
    bounds, projection = usual(task)
    setting = setting_of(task, bounds)
    keys = numbered(stream(seed, "bench", "augment", "targets"), range(count))

    def all_of_them() -> Augmented:
        return jax.block_until_ready(augment(keys, examples, setting, projection))

    found, seconds = all_of_them(), []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        all_of_them()
        seconds.append(time.perf_counter() - begun)
    verdict = np.asarray(found.verdict)
    accepted = verdict == Verdict.ACCEPTED
    tags = {"task": task.name}
    rows = [row("augmentations_per_s", tags, accepted.sum() / np.median(seconds), "1/s", n=count)]
    for one in Verdict:
        if one != Verdict.ORIGINAL and (verdict == one).any():
            share = (verdict == one).mean()
            rows.append(row("acceptance", tags | {"reason": one.name.lower()}, share, "", n=count))
    rows += _diversity(tags, examples, found, np.asarray(setting.bounds))
    measured = compared(task, simulator, setting, starts, examples, found)
    if accepted.any():
        within = measured["augmented"] <= np.maximum(TIMES * measured["original"], SAME)
        yardstick = tags | {"times": TIMES, "or_m": SAME}
        rows.append(row("resimulated_within", yardstick, within.mean(), "", n=within.size))
        touched = _touched(setting, examples, projection.skin)
        for name, which in () if touched is None else (("touched", touched), ("clear", ~touched)):
            some = within[which[accepted]]
            if some.size:
                rows.append(
                    row("resimulated_within", yardstick | {"obstacles": name}, some.mean(), "", n=some.size)
                )
    for method, errors in measured.items():
        for quantile in QUANTILES if len(errors) else ():
            value = np.quantile(errors, quantile)
            at = tags | {"method": method, "quantile": quantile}
            rows.append(row("resimulation_error_m", at, value, "m", n=len(errors)))
    return rows


def _touched(setting: Setting, examples: Examples, skin: float) -> np.ndarray | None:
    """Which examples come nearer to an obstacle than ``skin`` (m); None where nothing says how near."""
    found = jax.vmap(setting.clearance)(examples.states, examples.obstacles)
    return None if found is None else np.asarray(found.min(1)) < skin


def _diversity(tags: dict[str, str], examples: Examples, found: Augmented, bounds: np.ndarray) -> list[Row]:
    """How varied what was drawn and what was accepted is."""
    accepted, sound = np.asarray(found.verdict) == Verdict.ACCEPTED, np.asarray(examples.sound)
    rows = []
    for method, transforms, which in (
        ("augmented", found.transform, accepted),
        ("random", found.target, np.ones_like(accepted)),
    ):
        if which.any():
            value, own = divergence(np.asarray(transforms)[which], bounds), tags | {"method": method}
            rows.append(row("diversity", own, value, "nats", n=int(which.sum())))
    if accepted.any():
        there, before = (np.asarray(states.bodies()) for states in (found.states, examples.states))
        nearest = np.median(nearest_distances(there[accepted], before[sound])[0])
        own = tags | {"method": "augmented"}
        rows.append(row("nearest_original_m", own, nearest, "m", n=int(accepted.sum())))
    return rows


def compared(
    task: Task,
    simulator: Simulator,
    setting: Setting,
    starts: SimState,
    examples: Examples,
    found: Augmented,
) -> Mapping[str, np.ndarray]:
    """Errors (m) of the accepted augmentations, of their originals, and of what was drawn for them."""
    accepted = np.asarray(found.verdict) == Verdict.ACCEPTED
    sound = np.asarray(examples.sound)
    count = len(sound)
    aside = jnp.zeros((count, 6)).at[:, 0].set(ASIDE)
    errors = {
        "augmented": (jnp.where(accepted[:, None], found.transform, 0.0), accepted),
        "original": (aside, accepted),
        "random": (found.target, sound),
    }
    return {
        name: resimulation_errors(task, simulator, setting, starts, examples, parameters)[chosen]
        for name, (parameters, chosen) in errors.items()
    }
