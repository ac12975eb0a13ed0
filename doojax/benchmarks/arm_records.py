"""Records of trials of `doojax.tasks.arm_reaching`: what was executed, and what was tried at each command."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.benchmarks.arm_control import BROKEN, LONGEST, METHODS, SEED, Command, Sampled, Trial, cable_end
from doojax.benchmarks.arm_control import trial as controlled
from doojax.experiments.trials.record_files import save_record
from doojax.experiments.trials.records import Event, Look, TrialRecord
from doojax.experiments.trials.tried import KEPT, Tried
from doojax.simulation.scenes import obstacles_at
from doojax.simulation.state import SimState
from doojax.tasks.arm_reaching import GOAL_RADIUS, HAND, RADIUS, ArmReaching, Reaching
from doojax.tasks.arms import rope_ends


class Watched:
    """What was tried, command by command; a trial's `watch`."""

    def __init__(self):
        """Before the first command."""
        self.actions: list[np.ndarray] = []
        self._tried: list[tuple[np.ndarray, ...]] = []
        self._terms: list[dict[str, float]] = []

    def __call__(self, command: Command, state: SimState, action: Float[Array, "A"]) -> None:
        """See `doojax.benchmarks.arm_control.trial`; the plan that was chosen is rolled out once more."""
        self.actions.append(np.asarray(action, np.float32))
        if not isinstance(command, Sampled) or command.last is None:
            return
        nominal, report = command.last
        costs = np.asarray(report.costs)
        best = np.argsort(np.where(np.isfinite(costs), costs, np.inf), kind="stable")[:KEPT]
        tips = np.asarray(cable_end(report.states.seen.points))[best]
        chosen = command.rollouts.many(state, nominal.controls[None], nominal.duration[None])
        planned = np.asarray(cable_end(chosen.seen.points[0]))
        joints, tool = np.asarray(chosen.seen.joints[0]), np.asarray(chosen.seen.grippers[0, :, HAND])
        self._tried.append((tips, costs[best], planned, joints, tool))
        weights = np.asarray(report.weights)
        counted = weights > 0  # others may have broken down, and cost NaN
        self._terms.append(
            {name: float((weights * np.asarray(cost))[counted].sum()) for name, cost in report.terms.items()}
        )

    @property
    def tried(self) -> Tried | None:
        """All of it; None where nothing is sampled."""
        if not self._tried:
            return None
        arrays = (np.stack(values) for values in zip(*self._tried, strict=True))
        terms = {name: np.array([one[name] for one in self._terms]) for name in self._terms[0]}
        return Tried(*arrays, terms=terms)


def record_of(task: ArmReaching, name: str, number: int, done: Trial, watched: Watched) -> TrialRecord:
    """The record of a trial; its ``replay`` holds joints, actions, and what `Tried.packed` does."""
    seen = jax.tree.map(
        lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]),
        *[task.simulator.observation(state) for state in done.states],
    )
    state, last = done.drawn.state, len(done.states) - 1
    broken = int(done.states[-1].faults) & BROKEN
    end = "the goal is reached" if done.reached else f"the limit of {LONGEST} commands is met"
    tried = watched.tried
    points = np.asarray(rope_ends(task.scene, jax.tree.map(jnp.asarray, seen)))
    replay: dict[str, Any] = {
        "joints": np.asarray(seen.state.joints, np.float32),
        "actions": np.array(watched.actions, np.float32).reshape(last, -1),
    }
    return TrialRecord(
        task="arm_reaching",
        method=name,
        seed=SEED,
        look=Look(RADIUS),
        obstacles=obstacles_at(task.scene, state.obstacle_position, state.obstacle_quaternion),
        goal=np.asarray(done.drawn.goal, np.float32),
        goal_radius=GOAL_RADIUS,
        goal_point=points.shape[1] - 1,
        points=points,
        grippers=np.asarray(seen.hands),
        plans=(),
        events=(Event(0, "execute"), Event(last, "end", "the simulation broke down" if broken else end)),
        reached=done.reached,
        period=task.scene.control_period,
        about={"scene": number, "commands": last},
        replay=replay | (tried.packed() if tried else {}),
    )


def recorded(task: ArmReaching, drawn: Reaching, number: int, name: str, folder: Path) -> Trial:
    """One trial of a method, whose record is then ``folder/METHOD/NUMBER.npz``, whole or not at all."""
    watched = Watched()
    done = controlled(task, drawn, number, METHODS[name], watched)
    save_record(folder / name / f"{number:05d}.npz", record_of(task, name, number, done, watched))
    return done
