"""Point reaching by MPPI and regrasps: algorithm 6 of the thesis, and what a trial's record holds."""

import time
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from doojax.experiments.regrasping.choice import Method, choose, listing
from doojax.experiments.regrasping.control import PERIOD, PRESETS, controller
from doojax.experiments.regrasping.planner import PlannerSettings, Plans, signature_now
from doojax.experiments.regrasping.world import Executed, World, as_jax
from doojax.experiments.trials.records import Event, Look, TrialRecord
from doojax.experiments.trials.replay import first_state
from doojax.keys import numbered, stream
from doojax.planning.regrasp import Strategy
from doojax.planning.traps import TrapSettings, regrasped, seen, watched
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.tasks.arms import BASE, ArmTask, Start
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


@dataclass
class Ledger:
    """What a trial says of itself while it runs; all that JSON can hold."""

    events: list[Event] = field(default_factory=list)
    steps: list[dict[str, Any]] = field(default_factory=list)  # of control
    regrasps: list[dict[str, Any]] = field(default_factory=list)
    planning: float = 0.0  # s on the wall
    executing: float = 0.0


def run_trial(
    task: ArmTask,
    simulator: MujocoSimulator,
    start: Start,
    method: Method,
    seed: int,
    number: int,
    settings: RegraspSettings = RegraspSettings(),
) -> TrialRecord:
    """One trial in the scene with this number.

    Its record's ``about`` has ``steps`` (of control: signature, trap ratio, costs), ``regrasps`` (candidates
    with their costs, the choice, blocklist, signatures as planned and as executed, seconds), iterations,
    seconds of planning, of executing, and simulated; ``replay`` has the first state, actions, joints and
    where hands hold the rope, see `doojax.experiments.regrasping.world.repeated`.

    Raises:
        ValueError: for an unknown method.
    """
    if method not in get_args(Method):
        raise ValueError(f"unknown method {method!r}, expected one of {', '.join(get_args(Method))}")
    world = World(task, simulator, start)
    run = Run(world, start, method, stream(seed, "regrasping", task.name, "trial", str(number)), settings)
    reached = run.to_the_end()
    execution, ledger = run.execution, run.ledger
    goal = np.asarray(start.goal, np.float32)
    about = {
        "iterations": len(ledger.steps),
        "grasps": sum(bool(one["changed"]) for one in ledger.regrasps),
        "planning_s": ledger.planning,
        "executing_s": ledger.executing,
        "simulated_s": len(execution.actions) * world.scene.control_period,
        "scene": number,
        "attempt": start.attempt,
        "settings": asdict(settings),
        "skeleton": list(world.skeleton.names),
        "steps": ledger.steps,
        "regrasps": ledger.regrasps,
    }
    rope = world.scene.rope_part.parameters
    return TrialRecord(
        task=task.name,
        method=method,
        seed=seed,
        look=Look(rope.radius, floor=0.0 if world.scene.floor else None),
        obstacles=simulator.obstacles(start.state),
        goal=goal,
        goal_radius=task.goal_radius,
        goal_point=round(task.keypoint * world.scene.links),
        points=np.stack(execution.ropes),
        grippers=np.stack(execution.hands),
        plans=(),
        events=tuple(ledger.events),
        reached=reached,
        period=world.scene.control_period,
        about=about,
        replay={
            **first_state(start.state),
            "actions": np.array(execution.actions, np.float32).reshape(-1, len(world.scene.layout.driven)),
            "held": np.array(execution.held, np.float32).reshape(-1, len(task.robot.tools)),
            "joints": np.stack(execution.joints),
        },
    )


class Run:
    """A trial that is under way."""

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
        self._watched = self._position().shape[0]

    def to_the_end(self) -> bool:
        """Algorithm 6; whether the keypoint reached the goal."""
        settings, execution, ledger = self.settings, self.execution, self.ledger
        most = settings.iterations or self.world.task.iterations
        trap = watched(self._watched, settings.trap)
        nominal, without = None, 0
        for iteration, key in enumerate(numbered(self.key, range(most))):
            for_control, for_grasp = jax.random.split(key)
            places = self.world.places(execution.state)
            trapped, ratio = True, float("nan")
            if not np.isnan(places).all():
                try:
                    nominal, terms = self._control(nominal, places, for_control)
                except ValueError as error:
                    return self._end(f"control found nothing to do: {error}", False)
                if self._is_reached():
                    ledger.steps.append(self._step(iteration, ratio, terms))
                    return self._end("the goal is reached", True)
                trap, trapped, ratio = seen(trap, jnp.asarray(self._position()), settings.trap)
                trapped, ratio = bool(trapped), float(ratio)
                ledger.steps.append(self._step(iteration, ratio, terms))
            else:
                ledger.steps.append(self._step(iteration, ratio, {}))
            if execution.fault:
                return self._end("the simulation broke down", False)
            if trapped:
                changed = self._regrasp(for_grasp, iteration)
                trap, nominal = regrasped(trap, settings.trap), None
                if self._is_reached():
                    return self._end("the goal is reached", True)
                nobody = np.isnan(self.world.places(execution.state)).all()
                without = without + 1 if nobody and not changed else 0
                if without >= GIVES_UP:
                    return self._end(f"no grasp came of {GIVES_UP} plannings in a row", False)
        return self._end(f"the limit of {most} iterations is met", False)

    def _position(self) -> Float[np.ndarray, "D"]:
        """What trap detection watches, as the released code does: half the rope's coordinates, and joints."""
        state, places = self.execution.state, self.world.scene.layout.places
        qpos = np.asarray(state.qpos).copy()
        joints = places[self.world.scene.driver.name].coordinates
        halved = np.setdiff1d(np.arange(len(qpos)), joints)
        qpos[halved] *= 0.5
        return qpos.astype(np.float32)

    def _control(
        self, nominal: Any, places: tuple[float, ...], key: Key[Array, ""]
    ) -> tuple[Any, dict[str, float]]:
        begun = time.perf_counter()
        mppi = controller(self.world, places, self.goal, PRESETS[self.settings.preset])
        nominal, report = mppi(mppi.start() if nominal is None else nominal, self.execution.state, key)
        report.check()
        weights = np.asarray(report.weights)
        chosen = weights > 0  # others may have broken down, and cost NaN
        terms = {
            name: float((weights[chosen] * np.asarray(cost)[chosen]).sum())
            for name, cost in report.terms.items()
        }
        control = np.asarray(nominal.controls[0])
        planned = time.perf_counter()
        action = np.zeros(len(self.world.scene.layout.driven))
        action[np.array(self.world.task.actuated)] = control
        self.execution.act(action, round(PERIOD / self.world.scene.control_period))
        self._spent(planned - begun, time.perf_counter() - planned)
        return nominal.advanced(), terms

    def _regrasp(self, key: Key[Array, ""], iteration: int) -> bool:
        """Plan and execute a change of grasps; whether one was executed."""
        begun = time.perf_counter()
        plans = Plans(self.world, as_jax(self.execution.state), key, self.settings.planner)
        before = int(self.blocklist.length)
        chosen, self.blocklist = choose(
            self.method, plans, self.blocklist, self.world.task.keypoint, jax.random.fold_in(key, 3_000)
        )
        listed = int(self.blocklist.length) > before
        planned = time.perf_counter()
        note = self._note(plans, chosen, listed, iteration)
        changed = False
        if chosen is not None:
            changed = self._execute(plans, chosen, note)
        self._spent(planned - begun, time.perf_counter() - planned)
        self.signature = signature_now(self.world, self.execution.state)
        note |= {
            "changed": changed,
            "executed_signature": str(self.signature),
            "held": _places(self.world.places(self.execution.state)),
            "planning_s": planned - begun,
            "seconds": plans.seconds,
            "blocklist": listing(self.blocklist),
        }
        self.ledger.regrasps.append(note)
        return changed

    def _execute(self, plans: Plans, chosen: int, note: dict[str, Any]) -> bool:
        """Let go, move, grasp; whether the hand that went somewhere holds the rope then."""
        execution, candidates = self.execution, plans.candidates
        for hand in np.flatnonzero(candidates.let_go[chosen]):
            execution.release(int(hand))
        if candidates.let_go[chosen].any():
            execution.settle()
        done = True
        for hand in np.flatnonzero(candidates.moving[chosen]):
            done = execution.follow(plans.waypoints[chosen])
            gap = execution.grasp(int(hand), float(candidates.places[chosen, hand]))
            note |= {"arrived": done, "gap": gap}
            done = not np.isnan(self.world.places(execution.state)[hand])
        execution.settle()
        base = np.array(BASE, np.float32)
        off = np.linalg.norm(execution.ropes[-1] - base - plans.after.rope[chosen], axis=-1)
        note |= {"rope_off_mean": float(off.mean()), "rope_off_most": float(off.max())}
        self.ledger.events.append(Event(len(execution.ropes) - 1, "execute", describe(plans, chosen)))
        return done

    def _note(self, plans: Plans, chosen: int | None, listed: bool, iteration: int) -> dict[str, Any]:
        step = len(self.execution.ropes) - 1
        text = "no candidate is feasible" if chosen is None else describe(plans, chosen)
        self.ledger.events.append(Event(step, "plan", text))
        total = plans.costs(self.blocklist)
        signatures = [jax.tree.map(lambda leaf, i=i: leaf[i], plans.signatures) for i in range(len(total))]
        return {
            "step": step,
            "iteration": iteration,
            "places_now": _places(plans.now),
            "signature": str(plans.signature_before),
            "listed": listed,
            "chosen": chosen,
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
                }
                for row in range(len(total))
            ],
        }

    def _is_reached(self) -> bool:
        tip = self.execution.ropes[-1][round(self.world.task.keypoint * self.world.scene.links)]
        return bool(np.linalg.norm(tip - self.goal) < self.world.task.goal_radius)

    def _step(self, iteration: int, ratio: float, terms: dict[str, float]) -> dict[str, Any]:
        tip = self.execution.ropes[-1][round(self.world.task.keypoint * self.world.scene.links)]
        return {
            "iteration": iteration,
            "step": len(self.execution.ropes) - 1,
            "to_goal": float(np.linalg.norm(tip - self.goal)),
            "ratio": None if np.isnan(ratio) else ratio,
            "signature": str(self.signature),
            **{f"cost_{name}": value for name, value in terms.items()},
        }

    def _spent(self, planning: float, executing: float) -> None:
        self.ledger.planning += planning
        self.ledger.executing += executing

    def _end(self, text: str, reached: bool) -> bool:
        self.ledger.events.append(Event(len(self.execution.ropes) - 1, "end", text))
        return reached


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
