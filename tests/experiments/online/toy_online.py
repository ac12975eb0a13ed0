"""Online learning on the toy task, small: what several tests share."""

from functools import cache
from pathlib import Path

from doojax.experiments.online.reliability import ReliabilityLearner, ReliabilitySettings
from doojax.experiments.online.runner import Setting, run_seed
from doojax.experiments.trials.scenes import draw_scenes
from tests.experiments.trials.toy_trials import PLANNING, SETTINGS, SIMULATOR, TOY
from tests.planning.problems import Towed

SMALL = ReliabilitySettings(steps=20, batch_size=32, capacity=2048, attempts=64)
ERROR = 0.01  # m


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


def learner(enrichment="augmentation", **changes) -> ReliabilityLearner:
    """Dynamics that know no wall, and a classifier that is to learn of it."""
    settings = changes.pop("settings", SMALL)
    return ReliabilityLearner(
        "classifier", TOY, Towed(), ERROR, SETTINGS.actions, enrichment, settings, **changes
    )


def run(folder: Path, iterations: int, who=None, tell=lambda text: None, **changes) -> Path:
    """Seed 0."""
    run_seed(folder, setting(**changes), who or learner(), 0, iterations, tell)
    return folder
