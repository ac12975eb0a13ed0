"""Threading a rope through fixtures, and then bringing its end to a place: algorithm 7 of the thesis.

Each fixture is a subgoal. Control brings the rope's end through its opening; then the other hand takes it on
the far side, which makes the signature that of a rope through all fixtures so far. Where thesis and released
code differ, this does as the code: control that pushes on brings ever farther points of the rope to the
opening, and the signature of the executed state is looked at in every iteration.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from doojax.experiments.regrasping.choice import choose_threading, stuck_counts
from doojax.experiments.regrasping.control import Aim
from doojax.experiments.regrasping.run import GIVES_UP, Run
from doojax.planning.regrasp import alternating_candidates
from doojax.tasks.arms import BASE
from doojax.topology.field import magnetic_field
from doojax.topology.signatures import Signature, same

FARTHER = 0.005  # along the rope: control aims at a point so much farther back while it pushes on
BACK = 0.05  # along the rope: from a hand that is stuck, where the other grasps


def normal_of(loop: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "3"]:
    """The unit vector along a loop's field in its middle: the way through it."""
    field = np.asarray(magnetic_field(jnp.asarray(loop), jnp.asarray(middle_of(loop))))
    return field / np.linalg.norm(field)


def middle_of(loop: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "3"]:
    """The mean of a loop's corners."""
    return np.asarray(loop)[:-1].mean(0)


def is_penetrated(loop: Float[np.ndarray, "P 3"], tip: Float[np.ndarray, "3"]) -> Bool[np.ndarray, ""]:
    """Has a point gone through a loop's disc (Wang et al. 2015)? All in one frame, m.

    That is beyond the loop's plane, by the direction of its field, and nearer to the axis through its middle
    than the farthest corner is. How far beyond does not matter, as in the released code.
    """
    offset, normal = tip - middle_of(loop), normal_of(loop)
    radius = np.linalg.norm(np.asarray(loop) - middle_of(loop), axis=-1).max()
    height = offset @ normal
    return np.asarray((height > 0) & (np.linalg.norm(offset - height * normal) < radius))


def subgoals(names: tuple[str, ...], threads: tuple[str, ...]) -> list[Signature]:
    """Signatures of one hand that holds a fastened rope which goes through the first, the first two, ..., all
    of ``threads``, among a skeleton's loops ``names``."""
    through = [threads[: count + 1] for count in range(len(threads))]
    return [Signature.of([tuple(int(one in own) for one in names)], len(names)) for own in through]


def pushed_back(aimed: float, held: float) -> float:
    """The point that control then aims at, when the fixture is penetrated but no grasp is taken."""
    return max(aimed - FARTHER, held)


class Threading:
    """Algorithm 7, under way."""

    def __init__(self, run: Run):
        """At the first fixture."""
        self.run, world = run, run.world
        names = world.skeleton.names
        loops = np.asarray(world.skeleton.loops) + np.array(BASE)  # world frame
        self.loops = [loops[names.index(name)] for name in world.task.threads]
        self.goals = subgoals(names, world.task.threads)
        self.subgoal = 0
        self.aimed = world.task.keypoint  # along the rope, what control brings to the opening
        self.without = 0

    def aim(self, subgoal: int, aimed: float) -> Aim:
        """Of control on the way to a subgoal; after the last fixture to the goal."""
        if subgoal == len(self.loops):
            return Aim(self.run.goal, self.run.world.task.keypoint)
        return Aim(middle_of(self.loops[subgoal]), aimed, self.loops[subgoal])

    def to_the_end(self) -> bool:
        """Whether the rope goes through all fixtures, and its end is at the goal."""
        run = self.run
        for iteration, for_control, for_grasp in run.iterations():
            if np.isnan(run.places()).all():
                run.step(iteration, float("nan"), {}, subgoal=self.subgoal)
                self.regrasped(iteration, for_grasp, on_disc=False)
                self.without += 1
                if self.without >= GIVES_UP:
                    return run.end(f"no grasp came of {GIVES_UP} plannings in a row", False)
                continue
            self.without = 0
            try:
                terms = run.controlled(self.aim(self.subgoal, self.aimed), for_control)
            except ValueError as error:
                return run.end(f"control found nothing to do: {error}", False)
            trapped, ratio = run.trapped()
            run.step(iteration, ratio, terms, subgoal=self.subgoal, aimed=self.aimed)
            if run.execution.fault:
                return run.end("the simulation broke down", False)
            if self.subgoal == len(self.loops):
                if run.is_reached():
                    return self.at_the_goal()
                if trapped:
                    self.regrasped(iteration, for_grasp, on_disc=False)
                continue
            done = False
            if bool(is_penetrated(self.loops[self.subgoal], run.tip())):
                done = self.regrasped(iteration, for_grasp, on_disc=True)
            if trapped and not done and self.counts_as_stuck():
                self.regrasped(iteration, jax.random.fold_in(for_grasp, 1), on_disc=False)
            self.advance(done)
        return run.end(f"the limit of {run.most} iterations is met", False)

    def at_the_goal(self) -> bool:
        """The end of the trial: is the rope threaded?"""
        threaded = bool(same(self.run.signature, self.goals[-1]))
        text = "the goal is reached" if threaded else "the end is at the goal, but the rope is not threaded"
        return self.run.end(text, threaded)

    def counts_as_stuck(self) -> bool:
        """Does the method look whether control is trapped, here?"""
        held = ~np.isnan(self.run.places())
        hands = self.run.execution.hands[-1][held]
        return stuck_counts(self.run.method, hands, middle_of(self.loops[self.subgoal]))

    def advance(self, taken_on_disc: bool) -> None:
        """On to the next fixture if this one is threaded.

        With the signature that is when the executed state's is the subgoal's. The others, which do not look
        at it, go on when they have regrasped at the disc.
        """
        if self.run.method == "signature":
            taken_on_disc = bool(same(self.run.signature, self.goals[self.subgoal]))
        if taken_on_disc:
            self.subgoal += 1
            self.aimed = self.run.world.task.keypoint
            self.run.start_anew()

    def regrasped(self, iteration: int, key: Key[Array, ""], *, on_disc: bool) -> bool:
        """Plan and execute an alternating grasp: at the tip on the disc, else behind a hand that is stuck."""
        run, begun = self.run, time.perf_counter()
        places = np.array(run.places())
        held = float(np.nanmax(places)) if (~np.isnan(places)).any() else 1.0
        keypoint = run.world.task.keypoint if on_disc else max(held - BACK, 0.0)
        count = 1 if run.method == "wang" else run.settings.planner.count(threading=True)
        wanted = self.goals[min(self.subgoal, len(self.goals) - 1)]
        following = self.subgoal + on_disc  # what control is to do after the grasp
        plans = run.planned(
            alternating_candidates(places.tolist(), key, count, keypoint),
            keypoint,
            self.aim(following, run.world.task.keypoint),
            key,
            goal=wanted if run.method == "signature" else None,
            holds_on=True,
        )
        chosen = choose_threading(
            run.method,
            plans,
            run.blocklist,
            keypoint,
            jax.random.fold_in(key, 3_000),
            must_fit=on_disc or self.subgoal == len(self.loops),
        )
        about = {"on_disc": on_disc, "subgoal": self.subgoal}
        changed = run.regrasp(plans, chosen, begun, iteration, about)
        if chosen is None:
            self.aimed = pushed_back(self.aimed, held)
        else:
            self.aimed = run.world.task.keypoint
        if chosen is not None or not on_disc:
            run.start_anew()
        return changed
