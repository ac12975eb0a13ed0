"""Trials on the toy task: scenes, methods and settings that end in a second."""

from functools import cache

import jax
import jax.numpy as jnp

from doojax.experiments.trials.setting import Method, Trials, TrialSettings
from doojax.experiments.trials.trial import run_trials
from doojax.planning import RrtSettings, simulated, simulated_start
from doojax.planning.recovery import RandomRecovery
from doojax.tasks import make_task, point_goal
from doojax.tasks.toy import HEIGHT
from tests.planning.problems import BLIND, CAREFUL, TIMID, Towed

TOY = make_task("toy")
SIMULATOR = TOY.simulator()
STARTS = jax.jit(jax.vmap(SIMULATOR.reset))
PLANNING = RrtSettings(lanes=16, extensions=480, duration=8, candidates=2, stuck_after=16)
SETTINGS = TrialSettings(searches=4, actions=60)

METHODS = {
    "classifier": Method("classifier", Towed(), CAREFUL),
    "no_classifier": Method("no_classifier", Towed(), BLIND),
    "oracle": Method("oracle", simulated(SIMULATOR), BLIND, begin=simulated_start),
    "timid": Method("timid", Towed(), TIMID),
    "random_recovery": Method("random_recovery", Towed(), TIMID, RandomRecovery()),
}
GOALS = ((-0.3, 0.1), (0.3, -0.1), (-0.2, -0.3))  # the second behind the wall


def trials(goals=GOALS, seed: int = 0) -> Trials:
    """One trial for each goal, each from a start of its own."""
    starts = STARTS(jax.random.split(jax.random.key(seed), len(GOALS)))
    aims = [point_goal(TOY, jnp.array([*goal, HEIGHT])) for goal in goals]
    return Trials(starts, jax.tree.map(lambda *leaves: jnp.stack(leaves), *aims), [7, 8, 9], 2**40)


@cache
def records(method: str):
    """What a method does in all of them."""
    return run_trials(TOY, SIMULATOR, METHODS[method], PLANNING, SETTINGS, trials(), keep_trees=True)
