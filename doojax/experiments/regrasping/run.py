"""A trial of arms that is under way: control, regrasps, and all that its record will say of them."""

import time
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from doojax.experiments.regrasping.choice import STEPS_AHEAD, Method, listing
from doojax.experiments.regrasping.control import PERIOD, PRESETS, Aim, controller, foreseen, whole
from doojax.experiments.regrasping.planner import PlannerSettings, Plans, Question
from doojax.experiments.regrasping.pricing import signature_now
from doojax.experiments.regrasping.world import Executed, World, as_jax
from doojax.experiments.trials.records import Event
from doojax.keys import numbered
from doojax.planning.regrasp import Candidates, Strategy
from doojax.planning.traps import TrapSettings, regrasped, seen, watched
from doojax.tasks.arms import BASE, Start
from doojax.topology.signatures import Blocklist, Signature

MOST_LISTED = 256  # signatures on a blocklist
GIVES_UP = 5  # plannings in a row without a grasp, while nobody holds the rope


@dataclass(frozen=True)
class RegraspSettings:
    """How trials are run."""

    preset: Literal["quick", "thesis"] = "quick"  # of MPPI
    planner: PlannerSettings = field(default_factory=PlannerSettings)
    trap: TrapSettings = field(default_factory=TrapSettings)
    iterations: int | None = None  # of control, at most; by default the task's

    def __post_init__(self):
        """Refuse trials without control."""
        if self.iterations is not None and self.iterations < 1:
            raise ValueError(f"iterations is {self.iterations}, expected 1 or more")


@dataclass
class Seconds:
    """What a trial took on the wall: apart from its record, which is the same whenever it is run."""

    control: float = 0.0  # planning by MPPI
    plan_grasps: float = 0.0
    execute: float = 0.0  # simulating what was decided
    regrasps: list[dict[str, float]] = field(default_factory=list)  # planning of each, by its parts

    @property
    def wall(self) -> float:
        """All together."""
        return self.control + self.plan_grasps + self.execute


@dataclass
class Ledger:
    """What a trial says of itself while it runs; all that JSON can hold."""

    events: list[Event] = field(default_factory=list)
    steps: list[dict[str, Any]] = field(default_factory=list)  # of control
    regrasps: list[dict[str, Any]] = field(default_factory=list)
    seconds: Seconds = field(default_factory=Seconds)


class Run:
    """The state of a trial, and what an algorithm does with it."""

    def __init__(
        self, world: World, start: Start, method: Method, key: Key[Array, ""], settings: RegraspSettings
    ):
        """At its start."""
        self.method: Method = method
        self.world, self.settings, self.key = world, settings, key
        self.goal = np.asarray(start.goal, np.float32)  # world frame, m
        self.execution, self.ledger = Executed(world, start.state), Ledger()
        self.signature: Signature = signature_now(world, start.state)
        self.blocklist = Blocklist.empty(MOST_LISTED, like=self.signature)
        self.most = settings.iterations or world.task.iterations
        self._trap = watched(self._position().shape[0], settings.trap)
        self._nominal: Any = None

    def iterations(self):
        """Number and keys (of control, and of what is planned) of each iteration."""
        for iteration, key in enumerate(numbered(self.key, range(self.most))):
            yield iteration, *jax.random.split(key)

    def controlled(self, aim: Aim, key: Key[Array, ""]) -> dict[str, float]:
        """One control, executed; its cost by term.

        Raises:
            ValueError: no sample of control has a finite cost.
        """
        begun = time.perf_counter()
        mppi = controller(self.world, self.execution.state, aim, PRESETS[self.settings.preset])
        nominal, report = mppi(
            mppi.start() if self._nominal is None else self._nominal, self.execution.state, key
        )
        report.check()
        weights = np.asarray(report.weights)
        chosen = weights > 0  # others may have broken down, and cost NaN
        terms = {
            name: float((weights[chosen] * np.asarray(cost)[chosen]).sum())
            for name, cost in report.terms.items()
        }
        action = whole(self.world, np.asarray(nominal.controls[0]))
        planned = time.perf_counter()
        self.execution.act(action, round(PERIOD / self.world.scene.control_period))
        self.ledger.seconds.control += planned - begun
        self.ledger.seconds.execute += time.perf_counter() - planned
        self._nominal = nominal.advanced()
        self.signature = signature_now(self.world, self.execution.state)
        return terms

    def trapped(self) -> tuple[bool, float]:
        """Whether control makes no progress any more, and the ratio that says so."""
        self._trap, trapped, ratio = seen(self._trap, jnp.asarray(self._position()), self.settings.trap)
        return bool(trapped), float(ratio)

    def start_anew(self) -> None:
        """After a regrasp, or where one was looked for in vain: control and trap detection begin anew."""
        self._trap, self._nominal = regrasped(self._trap, self.settings.trap), None

    def places(self) -> tuple[float, ...]:
        """Where along the rope each hand holds it; NaN for one that does not."""
        return self.world.places(self.execution.state)

    def tip(self) -> Float[np.ndarray, "3"]:
        """The keypoint, world frame, m."""
        return self.execution.ropes[-1][round(self.world.task.keypoint * self.world.scene.links)]

    def is_reached(self) -> bool:
        """Is the keypoint at the goal?"""
        return bool(np.linalg.norm(self.tip() - self.goal) < self.world.task.goal_radius)

    def planned(
        self,
        candidates: Candidates,
        keypoint: float,
        aim: Aim,
        key: Key[Array, ""],
        *,
        goal: Signature | None = None,
        holds_on: bool = False,
    ) -> Plans:
        """What comes of candidates. For the TAMP methods that includes control towards ``aim``."""
        ahead, settings = None, self.settings
        if self.method in STEPS_AHEAD:
            ahead = partial(
                foreseen,
                self.world,
                aim=aim,
                steps=STEPS_AHEAD[self.method],
                settings=PRESETS[settings.preset],
                key=jax.random.fold_in(key, 4_000),
            )
        question = Question(candidates, keypoint, goal, holds_on, ahead)
        return Plans(self.world, as_jax(self.execution.state), question, key, settings.planner)

    def regrasp(
        self, plans: Plans, chosen: int | None, since: float, iteration: int, about: dict[str, Any]
    ) -> bool:
        """Execute what was chosen at last, if anything was, and note all; whether grasps changed.

        ``since`` is when planning began, by `time.perf_counter`.
        """
        planned = time.perf_counter()
        note = self._note(plans, chosen, iteration) | about
        changed = False
        if chosen is not None:
            changed = self._execute(plans, chosen, note)
        self.ledger.seconds.plan_grasps += planned - since
        self.ledger.seconds.execute += time.perf_counter() - planned
        self.ledger.seconds.regrasps.append({"planning": planned - since, **plans.seconds})
        self.signature = signature_now(self.world, self.execution.state)
        note |= {
            "changed": changed,
            "executed_signature": str(self.signature),
            "held": _places(self.places()),
            "blocklist": listing(self.blocklist),
        }
        self.ledger.regrasps.append(note)
        return changed

    def step(self, iteration: int, ratio: float, terms: dict[str, float], **about: Any) -> None:
        """Note one iteration."""
        self.ledger.steps.append(
            {
                "iteration": iteration,
                "step": len(self.execution.ropes) - 1,
                "to_goal": float(np.linalg.norm(self.tip() - self.goal)),
                "ratio": None if np.isnan(ratio) else ratio,
                "signature": str(self.signature),
                **{f"cost_{name}": value for name, value in terms.items()},
                **about,
            }
        )

    def end(self, text: str, reached: bool) -> bool:
        """Note why the trial ends."""
        self.ledger.events.append(Event(len(self.execution.ropes) - 1, "end", text))
        return reached

    def _position(self) -> Float[np.ndarray, "D"]:
        """What trap detection watches, as the released code does: half the rope's coordinates, and joints."""
        state, places = self.execution.state, self.world.scene.layout.places
        qpos = np.asarray(state.qpos).copy()
        joints = places[self.world.scene.driver.name].coordinates
        halved = np.setdiff1d(np.arange(len(qpos)), joints)
        qpos[halved] *= 0.5
        return qpos.astype(np.float32)

    def _execute(self, plans: Plans, chosen: int, note: dict[str, Any]) -> bool:
        """Let go, move, grasp, let go; whether the hand that went somewhere holds the rope then."""
        execution, candidates = self.execution, plans.candidates
        for hand in np.flatnonzero(plans.let_go_first[chosen]):
            execution.release(int(hand))
        execution.settle()  # motions are planned from where all is at rest
        done = True
        for hand in np.flatnonzero(candidates.moving[chosen]):
            arrived = execution.follow(plans.waypoints[chosen])
            gap = execution.grasp(int(hand), float(candidates.places[chosen, hand]))
            note |= {"arrived": arrived, "gap": gap}
            done = not np.isnan(self.places()[hand])
        if done:  # else the rope would be dropped
            for hand in np.flatnonzero(plans.let_go_last[chosen]):
                execution.release(int(hand))
        execution.settle()
        base = np.array(BASE, np.float32)
        off = np.linalg.norm(execution.ropes[-1] - base - plans.after.rope[chosen], axis=-1)
        note |= {"rope_off_mean": float(off.mean()), "rope_off_most": float(off.max())}
        self.ledger.events.append(Event(len(execution.ropes) - 1, "execute", describe(plans, chosen)))
        return done

    def _note(self, plans: Plans, chosen: int | None, iteration: int) -> dict[str, Any]:
        step = len(self.execution.ropes) - 1
        text = "no candidate is taken" if chosen is None else describe(plans, chosen)
        if not plans.feasible.any():
            text = "no candidate is feasible"
        self.ledger.events.append(Event(step, "plan", text))
        total = plans.costs(self.blocklist)
        signatures = [jax.tree.map(lambda leaf, i=i: leaf[i], plans.signatures) for i in range(len(total))]
        ahead = plans.known_ahead()
        return {
            "step": step,
            "iteration": iteration,
            "keypoint": plans.question.keypoint,
            "wanted_signature": None if plans.question.goal is None else str(plans.question.goal),
            "places_now": _places(plans.now),
            "signature": str(plans.signature_before),
            "chosen": chosen,
            "feasible": int(plans.feasible.sum()),
            "planned_signature": None if chosen is None else str(signatures[chosen]),
            "candidates": [
                {
                    "strategies": [Strategy(one).name for one in plans.candidates.strategies[row].tolist()],
                    "places": _places(plans.candidates.places[row]),
                    "why": plans.why[row],
                    "searched": bool(plans.searched[row]),
                    "signature": str(signatures[row]),
                    "cost": float(total[row]),
                    **{name: float(values[row]) for name, values in plans.terms.items()},
                    **({"ahead": ahead[row]} if row in ahead else {}),
                }
                for row in range(len(total))
            ],
        }


def describe(plans: Plans, chosen: int) -> str:
    """A candidate in words."""
    names = plans.candidates.strategies[chosen].tolist()
    hands = ("left", "right")
    said = [
        f"{hand} {Strategy(one).name}" + ("" if np.isnan(place) else f" {place:.2f}")
        for hand, one, place in zip(hands, names, plans.candidates.places[chosen], strict=True)
    ]
    return ", ".join(said)


def _places(places: Any) -> list[float | None]:
    return [None if np.isnan(one) else float(one) for one in places]
