"""Bringing a point of a rope to a place by control and regrasps: algorithm 6 of the thesis."""

import time

import jax
import numpy as np
from jaxtyping import Array, Key

from doojax.experiments.regrasping.choice import choose
from doojax.experiments.regrasping.control import Aim
from doojax.experiments.regrasping.run import GIVES_UP, Run
from doojax.planning.regrasp import candidates_of


def point_reaching(run: Run) -> bool:
    """Whether the keypoint reaches the goal within the iterations that there are."""
    aim, without = Aim(run.goal, run.world.task.keypoint), 0
    for iteration, for_control, for_grasp in run.iterations():
        trapped, ratio = True, float("nan")
        if np.isnan(run.places()).all():  # nothing can be controlled
            run.step(iteration, ratio, {})
        else:
            try:
                terms = run.controlled(aim, for_control)
            except ValueError as error:
                return run.end(f"control found nothing to do: {error}", False)
            reached = run.is_reached()
            if not reached:
                trapped, ratio = run.trapped()
            run.step(iteration, ratio, terms)
            if reached:
                return run.end("the goal is reached", True)
        if run.execution.fault:
            return run.end("the simulation broke down", False)
        if trapped:
            changed = _regrasped(run, aim, for_grasp, iteration)
            run.start_anew()
            if run.is_reached():
                return run.end("the goal is reached", True)
            nobody = np.isnan(run.places()).all()
            without = without + 1 if nobody and not changed else 0
            if without >= GIVES_UP:
                return run.end(f"no grasp came of {GIVES_UP} plannings in a row", False)
    return run.end(f"the limit of {run.most} iterations is met", False)


def _regrasped(run: Run, aim: Aim, key: Key[Array, ""], iteration: int) -> bool:
    """Plan and execute a change of grasps; whether one was executed."""
    begun = time.perf_counter()
    count, keypoint = run.settings.planner.count(threading=False), run.world.task.keypoint
    plans = run.planned(candidates_of(run.places(), key, count, keypoint), keypoint, aim, key)
    before = int(run.blocklist.length)
    chosen, run.blocklist = choose(run.method, plans, run.blocklist, keypoint, jax.random.fold_in(key, 3_000))
    return run.regrasp(plans, chosen, begun, iteration, {"listed": int(run.blocklist.length) > before})
