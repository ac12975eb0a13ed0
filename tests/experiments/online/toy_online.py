"""Online learning on the toy task, small: what several tests share."""

import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from doojax.experiments.online.reliability import ReliabilityLearner, ReliabilitySettings
from doojax.experiments.online.runner import Setting, run_seed
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.scenes import draw_scenes
from doojax.tasks.base import observed
from doojax.tasks.toy import HEIGHT, LINKS, PITCH
from tests.experiments.trials.toy_trials import PLANNING, SETTINGS, SIMULATOR, TOY
from tests.planning.problems import Towed, walls
from tests.records import record_of

SMALL = ReliabilitySettings(steps=60, batch_size=32, learning_rate=1e-2, capacity=2048, attempts=64)
ERROR = 0.01  # m
START, STEP = -0.2, 0.05  # m, of `record`


@cache
def held_out():
    """Some scenes to measure on."""
    return draw_scenes(TOY, 3, 0)


def setting(**changes) -> Setting:
    """As many trials in an iteration as in an evaluation, so that one compiled search serves both."""
    chosen = {
        "task": TOY,
        "simulator": SIMULATOR,
        "held_out": held_out(),
        "episodes": 3,
        "evaluate_every": 2,
        "evaluation_trials": 3,
        "planning": PLANNING,
        "budget": SETTINGS,
        "side_by_side": 3,
    }
    return Setting(**{**chosen, **changes})


def learner(enrichment="none", **changes) -> ReliabilityLearner:
    """Dynamics that know no wall, and a classifier that is to learn of it."""
    settings = changes.pop("settings", SMALL)
    return ReliabilityLearner(
        "classifier", TOY, Towed(), ERROR, SETTINGS.actions, enrichment, settings, **changes
    )


def made_trials(task, simulator, method, planning, budget, trials, keep_trees=False) -> list[TrialRecord]:
    """Trials without planning, in the place of `attempted`: the rope goes along x, all of it, from its start.

    How far it drifts depends on the classifier, so that another one makes other records.
    """
    seen, records = observed(simulator, trials.starts), []
    drift = 1e-3 * float(jnp.tanh(method.reliability.embed.bias.sum()))
    for i, number in enumerate(trials.numbers):
        steps = 0 if trials.wanted is not None and not trials.wanted[i] else 3 + number % 4
        way = np.arange(steps + 1)[:, None, None] * np.array([STEP, drift, 0.0])
        points = np.asarray(seen.points[i])[None] + way
        about = {"trial": int(number), "final_error_m": 0.1, "plan_s": time.perf_counter()}
        records.append(
            replace(
                record(steps),
                points=points.astype(np.float32),
                grippers=points[:, -1:].astype(np.float32),
                reached=number % 2 == 0,
                about=about,
            )
        )
    return records


def run(folder: Path, iterations: int, who=None, tell=lambda text: None, **changes) -> Path:
    """Seed 0."""
    run_seed(folder, setting(**changes), who or learner(), 0, iterations, tell)
    return folder


def record(steps: int, *, stops_after: int | None = None, away: float = 0.0) -> TrialRecord:
    """A hand that goes along x, with a straight rope behind it, until it stops; actions go on."""
    way = np.minimum(np.arange(steps + 1), steps if stops_after is None else stops_after)
    hand = np.stack([START + STEP * way, np.full(steps + 1, away), np.full(steps + 1, HEIGHT)], -1)
    behind = np.stack([np.arange(LINKS - 1, -1, -1.0) * PITCH, *np.zeros((2, LINKS))], -1)
    points = (hand[:, None] - behind[None]).astype(np.float32)
    actions = np.tile(np.array([STEP, 0, 0], np.float32), (steps, 1, 1))
    return record_of(
        points, method="none", obstacles=walls(), grippers=points[:, -1:], replay={"actions": actions}
    )
