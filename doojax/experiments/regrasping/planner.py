"""PlanGrasp: candidates, what comes of them in simulation, what they cost, and motions that lead there.

All candidates that let go of the same hands at first begin from one simulated release. Each is simulated with
all others side by side, from joints at which the hand is where it shall grasp: arms are put there (the rope
is not swept along the way, as in the thesis), the hand grasps, those let go that held on meanwhile, and
everything comes to rest.

Motions are what takes time. They are searched for in the order of what candidates cost without one, a few
side by side, until the best has one. What a motion adds to the cost is positive, so no other can be better.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from doojax.experiments.regrasping.pricing import (
    Clock,
    blocklisted,
    fitting,
    off_goal,
    priced,
    signatures_here,
)
from doojax.experiments.regrasping.world import REACH, Seen, World, as_jax, joints_of, point_of
from doojax.planning import regrasp_costs as costs
from doojax.planning.joint_motion import MotionPlanner, repaired_start
from doojax.planning.regrasp import Candidates, stays_put
from doojax.planning.regrasp_motion import SEARCH, SIDE_BY_SIDE, motions_to, tool_goals
from doojax.simulation.grasps import released
from doojax.simulation.state import SimState
from doojax.tasks.arms import teleported
from doojax.topology.signatures import Blocklist, Signature


@dataclass(frozen=True)
class PlannerSettings:
    """How many candidates."""

    # along the rope, for each combination of strategies; by default 20, and 10 of threading, as in the
    # thesis's code
    places: int | None = None
    weights: costs.RegraspWeights = costs.WEIGHTS

    def __post_init__(self):
        """Refuse what plans nothing."""
        if self.places is not None and not 1 <= self.places <= 1000:
            raise ValueError(f"places is {self.places}, expected 1 to 1,000")

    def count(self, threading: bool) -> int:
        """How many places there are."""
        return self.places or (10 if threading else 20)


@dataclass(frozen=True)
class Question:
    """What is to be planned."""

    candidates: Candidates
    keypoint: float  # along the rope, that hands are to be near to
    goal: Signature | None = None  # that is wanted
    holds_on: bool = False  # do hands let go only when the other has grasped?
    ahead: Callable[[SimState], float] | None = None  # what control from a state then comes to, costs


class Plans:
    """One planning: candidates, and what is known of each. Lengths in the base's frame, m."""

    def __init__(
        self,
        world: World,
        state: SimState,
        question: Question,
        key: Key[Array, ""],
        settings: PlannerSettings,
    ):
        """Simulate what comes of each candidate in a state."""
        self._world, self._key, self._settings, self.question = world, key, settings, question
        self._clock = Clock()
        self.now = world.places(state)
        self.candidates = question.candidates
        self._width = settings.count(bool(world.task.threads))
        let_go = self.candidates.let_go
        # those that let go before anything moves, and those that do once the other hand has grasped
        self.let_go_first = let_go & self.candidates.moving if question.holds_on else let_go
        self.let_go_last = let_go & ~self.let_go_first
        self.before = world.seen_one(state)
        count = len(self.candidates)
        self.why = [""] * count  # it cannot be done
        self.waypoints = [self.before.joints[None]] * count  # of each motion, [W, J]
        self.searched = ~self.candidates.moving.any(1)  # is its motion known?
        self.after = Seen(*(np.repeat(values[None], count, 0) for values in self.before))
        self.states = [state] * count  # that each leads to
        self._foreseen: dict[int, float] = {}
        for row in np.flatnonzero(stays_put(self.candidates, self.now)):
            self.why[row] = "the hand goes back to where it was"
        self._release(state)
        self._clock.lap("release")
        self._goals: list[np.ndarray] = [np.zeros((0, 0))] * count  # joints at which each may grasp, [G, J]
        for rows in self._alike(range(count)):
            self._reach(rows)
        self._clock.lap("inverse_kinematics")
        self._simulate([row for row in range(count) if not self.why[row]])
        self._clock.lap("simulate")
        self._price()
        self._clock.lap("price")

    @property
    def seconds(self) -> dict[str, float]:
        """That each part took."""
        return self._clock.seconds

    @property
    def feasible(self) -> Bool[np.ndarray, "C"]:
        """That nothing is known to speak against."""
        return np.array([not text for text in self.why])

    def costs(self, blocklist: Blocklist) -> Float[np.ndarray, "C"]:
        """Equation 5.3 as far as it is known; what cannot be done costs that alone."""
        weights = self._settings.weights
        blocked = np.asarray(blocklisted(self.signatures, blocklist, weights))
        known = sum(self.terms.values()) + blocked
        return np.where(self.feasible, known, weights.infeasible)

    def foreseen(self) -> Float[np.ndarray, "C"]:
        """What control then comes to, of all candidates that have a motion, by `Question.ahead`.

        Raises:
            ValueError: the question has nothing that says so.
        """
        if self.question.ahead is None:
            raise ValueError("this question looks at no control ahead: give it one that does")
        while wanted := [row for row in np.flatnonzero(self.feasible) if not self.searched[row]]:
            self._search([int(row) for row in wanted[:SIDE_BY_SIDE]])
        self._price()
        self._clock.lap("price")
        for row in np.flatnonzero(self.feasible).tolist():
            if row not in self._foreseen:
                self._foreseen[row] = self.question.ahead(self.states[row])
        self._clock.lap("ahead")
        return np.array([self._foreseen.get(row, np.inf) for row in range(len(self.candidates))])

    def known_ahead(self) -> dict[int, float]:
        """What `foreseen` found that is finite, by candidate."""
        return {row: value for row, value in self._foreseen.items() if np.isfinite(value)}

    def fits(self) -> Bool[np.ndarray, "C"]:
        """Which candidates lead to the signature that is wanted; all where none is."""
        if self.question.goal is None:
            return np.ones(len(self.candidates), bool)
        return np.asarray(fitting(self.signatures, self.question.goal))

    def best(self, costs: Callable[["Plans"], Float[np.ndarray, "C"]]) -> int | None:
        """The candidate with the least of ``costs(plans)`` that has a motion; None if there is none."""
        while True:
            values = np.where(self.feasible, costs(self), np.inf)
            order = np.argsort(values, kind="stable")
            if not self.feasible[order[0]]:
                return None
            if self.searched[order[0]]:
                return int(order[0])
            wanted = [int(row) for row in order if self.feasible[row] and not self.searched[row]]
            self._search(wanted[:SIDE_BY_SIDE])
            self._price()

    def _alike(self, rows: Iterable[int]) -> list[list[int]]:
        """Rows that can be done and whose hand goes somewhere, in groups of one combination of strategies."""
        groups: dict[tuple, list[int]] = {}
        for row in rows:
            if self.candidates.moving[row].any() and not self.why[row]:
                groups.setdefault(tuple(self.candidates.strategies[row].tolist()), []).append(row)
        return list(groups.values())

    def _release(self, state: SimState) -> None:
        """What is left when hands have let go at first, once for each set of them."""
        let_go = self.let_go_first.tolist()
        sets = list(dict.fromkeys(map(tuple, let_go)))
        freed = []
        for own in sets:
            one = as_jax(state)
            for hand in np.flatnonzero(own):
                one = released(self._world.scene, one, int(hand))
            freed.append(one)
        resting, faulty = self._world.settled(freed)
        self._resting = {}
        for own, one, fault in zip(sets, resting, faulty, strict=True):
            if fault:
                for row in range(len(let_go)):
                    if tuple(let_go[row]) == own:
                        self.why[row] = "the rope is at fault when it is let go"
            self._resting[own] = one

    def _from(self, row: int) -> SimState:
        return self._resting[tuple(self.let_go_first[row].tolist())]

    def _begin(self, row: int) -> tuple[str, bool, Float[np.ndarray, "J"]]:
        """A candidate's tool, whether its arm moves alone, and where its motion begins."""
        robot, candidates = self._world.robot, self.candidates
        (hand,) = np.flatnonzero(candidates.moving[row])
        held = ~np.isnan(np.array(self.now)) & ~self.let_go_first[row]
        stays = bool((held & ~candidates.moving[row]).any())
        joints = np.clip(
            joints_of(self._world, self._from(row)), np.asarray(robot.low), np.asarray(robot.high)
        )
        return robot.tools[hand], stays, joints.astype(np.float32)

    def _reach(self, rows: list[int]) -> None:
        """Joints at which a hand is where it shall grasp."""
        world = self._world
        tool, alone, joints = self._begin(rows[0])
        rope = world.seen_one(self._from(rows[0])).rope
        hand = world.robot.tool(tool)
        aims = [point_of(rope, self.candidates.places[row, hand]) for row in rows]
        aims += [aims[-1]] * (self._width - len(aims))
        goals, free = tool_goals(
            world.robot,
            tool,
            world.task.moving,
            world.obstacles,
            world.floor,
            jnp.asarray(joints),
            jnp.asarray(np.stack(aims), jnp.float32),
            jax.random.fold_in(self._key, 1_000 + rows[0]),
            alone=alone,
        )
        for number, row in enumerate(rows):
            self._goals[row] = np.asarray(goals[number])[np.asarray(free[number])]
            if len(self._goals[row]):
                self.waypoints[row] = np.stack([joints, self._goals[row][0]])
            else:
                self.why[row] = "the place is out of reach"

    def _simulate(self, rows: list[int]) -> None:
        """What comes of candidates whose arms are where their waypoints end."""
        if not rows:
            return
        states = []
        for row in rows:
            one = self._from(row)
            for hand in np.flatnonzero(self.candidates.moving[row]):
                one = teleported(self._world.scene, as_jax(one), jnp.asarray(self.waypoints[row][-1]))
                one = self._world.held(one, int(hand), float(self.candidates.places[row, hand]))
            for hand in np.flatnonzero(self.let_go_last[row]):
                one = released(self._world.scene, as_jax(one), int(hand))
            states.append(one)
        after, faulty = self._world.settled(states)
        for row, one, fault in zip(rows, after, faulty, strict=True):
            seen, self.states[row] = self._world.seen_one(one), one
            for known, new in zip(self.after, seen, strict=True):
                known[row] = new
            held = [
                np.linalg.norm(point_of(seen.rope, place) - seen.hands[hand])
                for hand, place in enumerate(self.candidates.places[row])
                if not np.isnan(place)
            ]
            if fault or max(held) > REACH:
                self.why[row] = "the rope is at fault" if fault else "a hold is torn"

    def _search(self, rows: list[int]) -> None:
        """Motions of some candidates, side by side; what comes of one that ends elsewhere, anew."""
        world, elsewhere = self._world, []
        for group in self._alike(rows):
            tool, alone, joints = self._begin(group[0])
            own = jax.random.fold_in(self._key, 2_000 + group[0])
            self.searched[group] = True
            try:
                planner = MotionPlanner(world.robot, world.obstacles, world.task.moving, world.floor, SEARCH)
                start = repaired_start(planner, jnp.asarray(joints), own)
            except ValueError:
                for row in group:
                    self.why[row] = "the arms are too deep in collision to begin"
                continue
            goals = [self._goals[row] for row in [*group, *[group[-1]] * (SIDE_BY_SIDE - len(group))]]
            plan = motions_to(
                world.robot,
                tool,
                world.task.moving,
                world.obstacles,
                world.floor,
                start,
                goals,
                own,
                alone=alone,
            )
            for number, row in enumerate(group):
                if not plan.solved[number]:
                    self.why[row] = "no motion is found"
                    continue
                way = np.asarray(plan.waypoints[number])[: int(plan.count[number])]
                if not np.array_equal(way[-1], self.waypoints[row][-1]):
                    elsewhere.append(row)
                self.waypoints[row] = np.concatenate([joints[None], way])
        self._clock.lap("motions")
        self._simulate(elsewhere)
        self._clock.lap("simulate")

    def _price(self) -> None:
        world, weights = self._world, self._settings.weights
        places = np.where(self.feasible[:, None], self.candidates.places, np.array(self.now))
        many = signatures_here(
            world.robot,
            jnp.concatenate([self.before.joints[None], self.after.joints]),
            jnp.concatenate([self.before.rope[None], self.after.rope]),
            jnp.asarray(np.concatenate([np.array(self.now)[None], places]), jnp.float32),
            jnp.asarray(world.fastened),
            world.skeleton,
        )
        self.signature_before, self.signatures = (
            jax.tree.map(lambda leaf, s=s: leaf[s], many) for s in (0, slice(1, None))
        )
        geodesics, ropes = priced(
            jnp.asarray(places, jnp.float32),
            jnp.asarray(self.question.keypoint),
            jnp.asarray(self.before.rope),
            jnp.asarray(self.after.rope),
            weights,
        )
        ways = [
            float(costs.robot_motion(jnp.asarray(way), weights)) if known else 0.0
            for way, known in zip(self.waypoints, self.searched, strict=True)
        ]
        self.terms = {
            "geodesic": np.asarray(geodesics, float),
            "robot": np.array(ways),
            "rope": np.asarray(ropes, float),
        }
        if self.question.goal is not None:
            self.terms["goal"] = np.asarray(off_goal(self.signatures, self.question.goal, weights), float)
