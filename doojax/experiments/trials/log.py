"""What happened in one trial so far, and the record that it becomes."""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from doojax.actions import nothing_of
from doojax.experiments.trials.records import Event, EventKind, Look, PlanRecord, TrialRecord
from doojax.experiments.trials.replay import first_state
from doojax.planning import Goal, Plan, Tree
from doojax.planning.memory import Outcome
from doojax.simulation.state import SimState
from doojax.tasks.base import Task
from doojax.types import Obstacles

REACHED = "goal reached"


@dataclass
class Log:
    """What happened in one trial so far."""

    bodies: list[np.ndarray]  # where all were, m
    passive: int  # how many of them no action commands
    missing: float = np.inf  # m to the goal
    actions: list[np.ndarray] = field(default_factory=list)
    plans: list[PlanRecord] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    refuted: list[Outcome] = field(default_factory=list)  # executed steps that were not as predicted
    recoveries: int = 0
    extensions: int = 0
    plan_s: float = 0.0  # of searches and shortcuts; side by side, each trial's share of what all took
    end: str | None = None

    def note(self, kind: EventKind, text: str) -> None:
        """Something happened."""
        self.events.append(Event(len(self.actions), kind, text))

    def stop(self, why: str) -> None:
        """The trial is over."""
        self.end = why
        self.note("end", why)

    def record(self, task: Task, obstacles: Obstacles, start: SimState, goal: Goal) -> TrialRecord:
        """The record of a trial that is over; method, seed and number are left for who knows them."""
        targets, allowed = np.asarray(goal.targets), np.flatnonzero(np.asarray(goal.bodies)[0])
        points, grippers = np.split(np.stack(self.bodies), [self.passive], axis=1)
        ends = self.bodies[-1][allowed]
        distances = np.nan_to_num(np.linalg.norm(ends - targets[0], axis=-1), nan=np.inf)
        about: dict[str, Any] = {
            "end": self.end,
            "final_error_m": self.missing,
            "searches": len(self.plans),
            "extensions": self.extensions,
            "actions": len(self.actions),
            "recovery_actions": self.recoveries,
            "refuted": len(self.refuted),
            "plan_s": round(self.plan_s, 3),
            "more_targets": targets[1:].tolist(),
        }
        actions = np.array(self.actions, np.float32).reshape(-1, *nothing_of(task.actions).shape)
        return TrialRecord(
            task=task.name,
            method="",
            seed=0,
            look=Look.of(task.scene),
            obstacles=obstacles,
            goal=targets[0],
            goal_radius=float(goal.tolerance),
            goal_point=int(allowed[np.argmin(distances)]),
            points=points,
            grippers=grippers,
            plans=tuple(self.plans),
            events=tuple(self.events),
            reached=self.end == REACHED,
            period=task.scene.control_period,
            about=about,
            replay={"actions": actions, **first_state(start)},
        )


def record_plan(tree: Tree, plan: Plan, step: int, *, whole: bool) -> PlanRecord:
    """A search made at state ``step``, for the viewer: all that was tried, or only the nodes of the plan."""
    nodes = np.arange(int(tree.used)) if whole else plan.nodes
    path = plan.nodes if whole else np.arange(len(nodes))
    bodies = jax.tree.map(lambda leaf: jnp.asarray(leaf[nodes]), tree.state).bodies()
    points, grippers = np.split(np.asarray(bodies), [tree.state.passive], axis=-2)
    return PlanRecord(
        step=step,
        parent=np.asarray(tree.parent[nodes] if whole else path - 1),
        points=points,
        grippers=grippers,
        accepted=np.asarray(tree.accepted[nodes]),
        path=path,
        score=np.asarray(tree.score[nodes]),
    )


def element(tree: Any, index: int) -> Any:
    """One of a batch."""
    return jax.tree.map(lambda leaf: leaf[index], tree)
