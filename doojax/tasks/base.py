"""What a task is: what is simulated, and how its starts, obstacles, actions and goals are drawn.

A task knows no planner and no learner. Every sampler is a pure function of one element. Its phase is chosen
when it is made: whoever plans, collects or judges with it need not name it.
"""

from typing import TYPE_CHECKING, Any, Literal, Protocol, get_args, runtime_checkable

from jaxtyping import Array, Bool, Float
from numpy import ndarray

from doojax.actions import ActionSpace
from doojax.geometry.box import Box as Box
from doojax.goals import Goal
from doojax.types import Obstacles

if TYPE_CHECKING:
    from doojax.simulation.state import Simulator

Phase = Literal["unconstrained", "constrained"]
"""Phase one: no obstacles, nothing overstretched. Phase two: everything that can get in the way."""


@runtime_checkable
class Task(Protocol):
    """A manipulation problem; `doojax.tasks.make_task` builds one by name. Hashable and immutable."""

    @property
    def name(self) -> str:
        """The name that `make_task` knows it by."""
        ...

    @property
    def phase(self) -> Phase:
        """In which its starts are drawn and its actions are valid."""
        ...

    @property
    def scene(self) -> Any:
        """What is simulated, in both phases: a `Scene`, or what has its digest and control_period."""
        ...

    @property
    def grippers(self) -> int:
        """How many bodies actions command."""
        ...

    @property
    def trajectory_states(self) -> int:
        """States of a trajectory in the phase's data."""
        ...

    @property
    def actions(self) -> ActionSpace:
        """What can be done."""
        ...

    @property
    def blank(self) -> Any:
        """One `doojax.types.State` of zeros: its type and shapes are those of all states of the task."""
        ...

    @property
    def workspace(self) -> Box:
        """Where all bodies can be, and so every goal, metres."""
        ...

    @property
    def goal_threshold(self) -> float:
        """Metres within which a goal counts as reached."""
        ...

    @property
    def goal_point(self) -> int:
        """The body that is to reach a goal that names none."""
        ...

    def simulator(self, engine: str = "auto") -> "Simulator":
        """The task on an engine: mujoco, mjx, warp, or auto (the fastest on this machine)."""
        ...

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Goal:
        """A goal, clear of the obstacles."""
        ...

    def reach(self) -> Float[ndarray, "K K"]:
        """How far apart (m) each two bodies can get; infinite where nothing holds them together."""
        ...


@runtime_checkable
class Sampling(Protocol):
    """What a task may have besides: samples of its own for searches, where no rope's would do."""

    def sample(
        self,
        key: Array,
        workspace: Box,
        shape: Float[Array, "K 3"],
        goal: Goal,
        towards_goal: Bool[Array, ""],
    ) -> Float[Array, "K 3"]:
        """Places (m) of all bodies that a branch is to head for: a `doojax.planning.metric.Sampler`."""
        ...


def observed(simulator: "Simulator", states: Any) -> Any:
    """What a planner sees of a batch of simulations: a `State`."""
    return simulator.observations(states).state


def check_phase(phase: str) -> None:
    """Raise ValueError for an unknown phase."""
    if phase not in get_args(Phase):
        raise ValueError(f"unknown phase {phase!r}, expected one of {', '.join(get_args(Phase))}")
