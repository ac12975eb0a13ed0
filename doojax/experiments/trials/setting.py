"""What a trial is given: a method, a start and a goal, and when it ends."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from doojax.models.arms import ArmsFeasible
from doojax.models.policy import Policy
from doojax.models.protocols import Dynamics, Recovery, Reliability
from doojax.planning import Goal, HostDynamics
from doojax.simulation.state import SimState, Simulator
from doojax.tasks.base import observed
from doojax.types import State

MOST = 1_000_000  # searches or actions


@dataclass(frozen=True, eq=False)
class Method:
    """With what a trial is planned."""

    name: str
    dynamics: Dynamics | HostDynamics
    reliability: Reliability
    recovery: Recovery | None = None  # None: a trial that is stuck is given up
    begin: Callable[[Simulator, SimState], State] = observed  # the state that a plan starts from
    error_threshold_m: float | None = None  # of the model error, below which a prediction counts as right
    policy: Policy | None = None  # if there is one, it acts, and nothing is planned
    arms: ArmsFeasible | None = None  # what carries the hands; the reliability has it, too


@dataclass(frozen=True)
class TrialSettings:
    """When a trial ends."""

    searches: int = 10
    actions: int = 200  # executed control periods, recoveries included
    replan_distance: float | None = None  # m, RMS over points, from the plan: beyond it, execution stops

    def __post_init__(self):
        """Refuse what tries nothing."""
        for name in ("searches", "actions"):
            if not 1 <= getattr(self, name) <= MOST:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 1 to {MOST:,}")
        if self.replan_distance is not None and not self.replan_distance > 0:
            raise ValueError(f"replan_distance is {self.replan_distance}, expected a positive length (m)")


class Trials(NamedTuple):
    """R trials that run side by side."""

    starts: SimState
    goals: Goal
    numbers: Sequence[int]  # with the seed, they say what is random in each trial
    seed: int = 0
    wanted: Sequence[bool] | None = None  # by default all are; the others fill up the batch and end at once
    purpose: str = "trials"  # what for: the random stream's name
