"""OMPL's control::RRT with our models, one transition at a time: the peer of `doojax.benchmarks.planner`.

OMPL calls back into Python for every step. The call runs dynamics, constraint and bounds in one compiled
function and leaves the states where they are; OMPL sees the goal's point and the grippers, which makes a good
space for it: uniform samples of the whole rope's coordinates would all be tangles. The full state is looked
up by a number that travels with it, at weight zero in the distance. Actions have the tasks' distribution.
"""

import gc
import time
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.keys import generator
from doojax.planning import Problem, Rrt
from doojax.types import Obstacles, RopeState, Transition

SEED = 0


class Found(NamedTuple):
    """One search of one planner, or all of a round; ``solved`` if all were."""

    seconds: float
    accepted: int
    extensions: int
    solved: bool


class Ompl:
    """OMPL's control::RRT with the same models and budget."""

    def __init__(self, ours: Rrt):
        """Compile one transition."""
        from ompl import util  # pyright: ignore[reportMissingImports]

        util.setLogLevel(util.LOG_ERROR)
        util.RNG.setSeed(1 + SEED)
        self._task: Any = ours.task
        self._settings = ours.settings
        self._step = jax.jit(partial(_transition, ours))

    def solve(self, problem: Problem) -> Found:
        """Plan until the goal is reached or the budget is spent."""
        from ompl import base, control  # pyright: ignore[reportMissingImports]

        task, settings = self._task, self._settings
        one = jax.tree.map(lambda leaf: leaf[0], problem)
        states, accepted = [one.start], [True]
        low, high = np.array(task.workspace.low), np.array(task.workspace.high)
        begin = np.asarray(_features(task, one.start))
        low, high = np.minimum(low, begin.min(0)), np.maximum(high, begin.max(0))
        axes = np.flatnonzero(high - low > 1e-3)  # a planar task has two
        seen = 1 + task.grippers  # the goal's point and the grippers

        features = base.RealVectorStateSpace(seen * len(axes))
        features.setBounds(_bounds(base, np.tile(low[axes], seen), np.tile(high[axes], seen)))
        number = base.RealVectorStateSpace(1)
        number.setBounds(_bounds(base, [0.0], [1e9]))
        space = base.CompoundStateSpace()
        space.addSubspace(features, 1.0)
        space.addSubspace(number, 0.0)
        angles = len(axes) - 1
        controls = control.RealVectorControlSpace(space, task.grippers * len(axes))
        ends = ([-np.pi] * angles + [0.0], [np.pi] * angles + [task.actions.longest])
        controls.setBounds(_bounds(base, *(np.tile(end, task.grippers) for end in ends)))

        def put(state: Any, index: int, values: np.ndarray) -> None:
            for axis, value in enumerate(values.tolist()):
                state[0][axis] = value
            state[1][0] = index

        def propagate(state: Any, command: Any, duration: float, result: Any) -> None:
            before = states[int(state[1][0])]
            polar = np.array([command[i] for i in range(task.grippers * len(axes))], dtype=np.float32)
            after, fine, values = self._step(one.obstacles, before, polar.reshape(task.grippers, -1))
            states.append(after)
            accepted.append(bool(fine))
            put(result, len(states) - 1, np.asarray(values)[:, axes].ravel())

        def usable(state: Any) -> bool:
            return accepted[int(state[1][0])]

        class Target(base.GoalSampleableRegion):
            def distanceGoal(self, state: Any) -> float:
                place = np.array([state[0][axis] for axis in range(len(axes))])
                return float(np.linalg.norm(place - target[axes]))

            def sampleGoal(self, state: Any) -> None:
                hands = rng.uniform(np.tile(low[axes], task.grippers), np.tile(high[axes], task.grippers))
                put(state, 0, np.concatenate([target[axes], hands]))

            def maxSampleCount(self) -> int:
                return 1 << 30

        target, rng = np.asarray(one.goal.targets[0]), generator(SEED, "bench", "ompl")
        setup = control.SimpleSetup(controls)
        information = setup.getSpaceInformation()
        setup.setStatePropagator(propagate)
        setup.setStateValidityChecker(usable)
        information.setPropagationStepSize(1.0)
        information.setMinMaxControlDuration(1, settings.duration)
        start: Any = space.allocState()
        put(start, 0, begin[:, axes].ravel())
        setup.setStartState(start)
        goal = Target(information)
        goal.setThreshold(settings.goal_margin * float(one.goal.tolerance))
        setup.setGoal(goal)
        rrt = control.RRT(information)
        rrt.setGoalBias(settings.goal_bias)
        rrt.setIntermediateStates(True)
        setup.setPlanner(rrt)
        setup.setup()
        stop = base.PlannerTerminationCondition(lambda: len(states) > settings.extensions)
        gc.collect()
        begun = time.perf_counter()
        setup.solve(stop)
        seconds = time.perf_counter() - begun
        return Found(seconds, sum(accepted) - 1, len(states) - 1, setup.haveExactSolutionPath())


def _transition(
    ours: Rrt, obstacles: Obstacles, state: RopeState, polar: Float[Array, "G D"]
) -> tuple[RopeState, Bool[Array, ""], Float[Array, "S 3"]]:
    """What OMPL asks for: the next state, whether it may be used, and what OMPL sees of it."""
    length = polar[:, -1]
    if polar.shape[-1] == 2:
        direction = [jnp.cos(polar[:, 0]), jnp.sin(polar[:, 0]), jnp.zeros_like(length)]
    else:
        pitch, yaw = polar[:, 0], polar[:, 1]
        direction = [jnp.cos(pitch) * jnp.cos(yaw), jnp.cos(pitch) * jnp.sin(yaw), jnp.sin(pitch)]
    action = length[:, None] * jnp.stack(direction, axis=-1)
    after, uncertainty = ours.dynamics(obstacles, state, action)  # pyright: ignore[reportCallIssue]
    found = ours.reliability(obstacles, Transition(state, action, after, uncertainty))
    valid = ours.task.actions.valid(state, action)
    return after, valid & found.accepted, _features(ours.task, after)


def _features(task: Any, state: RopeState) -> Float[Array, "S 3"]:
    return jnp.concatenate([state.points[task.goal_point][None], state.grippers])


def _bounds(base: Any, low: Any, high: Any) -> Any:
    bounds = base.RealVectorBounds(len(low))
    for axis, (least, most) in enumerate(zip(low, high, strict=True)):
        bounds.setLow(axis, float(least))
        bounds.setHigh(axis, float(most))
    return bounds
