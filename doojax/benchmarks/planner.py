"""The planner beside OMPL's control::RRT, which is given the same jitted models, one transition at a time.

OMPL calls back into Python for every step. The call runs dynamics, constraint and bounds in one compiled
function and leaves the states where they are; OMPL sees the goal's point and the grippers, which makes a good
space for it: uniform samples of the whole rope's coordinates would all be tangles. The full state is looked
up by a number that travels with it, at weight zero in the distance. Actions have the tasks' distribution.

A second table tells what the samples of `doojax.planning.metric` are worth beside one point for the whole
rope, which the thesis's released code uses.
"""

import gc
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from rich.console import Console
from rich.table import Table

from doojax.benchmarks.stages import stages
from doojax.commands import command_line
from doojax.experiments.reports.provenance import digests
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import bootstrap
from doojax.experiments.reports.summary import publish_rows, row
from doojax.experiments.trials.methods import find_models, make_method, needed_models, pretrained_models
from doojax.experiments.trials.scenes import draw_scenes
from doojax.keys import generator, numbered, stream
from doojax.models import CollisionChecker
from doojax.planning import Goal, Problem, Rrt, RrtSettings, search
from doojax.planning.metric import point_sample, rope_sample
from doojax.simulation.scenes import parked_poses
from doojax.simulation.state import SimState, at_rest
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.tasks.toy import ToySimulator
from doojax.types import Obstacles, RopeState, Transition

SEED = 0
SCENES = 20
ROUNDS = 5  # in which all scenes are planned
SETTINGS = RrtSettings()
THESIS = RrtSettings(goal_bias=0.05, duration=49, candidates=1)


class Found(NamedTuple):
    """One search of one planner, or all of a round; ``solved`` if all were."""

    seconds: float
    accepted: int
    extensions: int
    solved: bool


class Towed(eqx.Module):
    """The toy task's rope without the wall: what a model of unconstrained motion predicts, exactly."""

    simulator: ToySimulator

    def __call__(
        self, obstacles: Obstacles, state: RopeState, action: Float[Array, "1 3"]
    ) -> tuple[RopeState, Float[Array, ""]]:
        """The next state; no uncertainty."""
        position, quaternion = parked_poses(1)
        positions = jnp.concatenate([state.points, state.grippers]).reshape(-1)
        before = at_rest(self.simulator.scene, positions, position, quaternion)
        return self.simulator.observe(self.simulator.step(before, action)), jnp.zeros(())


def planner(
    task: str = "toy",
    /,
    *,
    models: Path | None = None,
    method: str = "classifier",
    scenes: int = SCENES,
    publish: Path | None = None,
) -> None:
    """Measure accepted extensions per second and seconds to a solution beside OMPL.

    Both plan in the same scenes with the same models, taking turns, until the goal is reached in prediction
    or as many extensions are tried as our planner's default allows. Compilation is not counted.

    First one scene after another, as OMPL does. Then ours all scenes at once, as when trials are evaluated,
    with all processors, and OMPL again one after another, in one process, which is what it can do: rates are
    those of all scenes together, and their intervals say how rounds in the same scenes differ.

    Args:
        task: toy, which needs no models, rope_dragging or dual_gripper.
        models: a folder of trained models; by default those that come with doojax.
        method: whose models are used, such as classifier; not for toy.
        scenes: how many.
        publish: the folder of results whose summary.json gets the figures, such as results/planning; by
            default they are only shown.

    Raises:
        ModuleNotFoundError: OMPL is not installed; `pip install 'doojax[bench]'` does that.
        ValueError: for an unknown name, or models that are missing or of another task.
    """
    command = command_line(planner, locals())
    the_task = make_task(task)
    if task == "toy":
        ours = Rrt(Towed(ToySimulator(the_task.scene, "unconstrained")), CollisionChecker(), the_task)
        used = {}
    else:
        found = find_models(models, task) if models else pretrained_models(task)
        used = needed_models(method, found)
        chosen = make_method(method, the_task, the_task.simulator(), found)
        ours = Rrt(chosen.dynamics, chosen.reliability, the_task)
    problems = problems_of(the_task, scenes)
    ompl = Ompl(ours)
    parts: list[tuple[str, Callable[[], Any]]] = [
        ("one scene after another", lambda: take_turns(ours, ompl, problems)),
        ("all scenes at once", lambda: side_by_side(ours, ompl, problems)),
        ("samplers", lambda: compare_samplers(ours, problems)),
    ]
    results, together, samplers = [run() for run in stages(f"{task}, {scenes} scenes", parts)]
    rows = rate_rows(results, task=task) + solution_rows(task, results)
    rows += rate_rows(together, task=task, all_scenes=scenes) + sampler_rows(task, samplers)
    publish_rows(publish, command=command, seed=SEED, rows=rows, inputs=digests(used))
    table = Table("metric", "tags", "value", "95 % interval", title=f"{task}, {scenes} scenes")
    for one in rows:
        tags = ", ".join(str(tag) for name, tag in one.tags.items() if name != "task")
        interval = f"{one.low:.4g} to {one.high:.4g}" if one.low is not None else ""
        table.add_row(one.metric, tags, f"{one.value:.4g}", interval)
    Console().print(table)


def problems_of(task: Task, count: int) -> list[Problem]:
    """Batches of one problem each, in scenes of the kind that trials have."""
    drawn, simulator = draw_scenes(task, count, SEED), task.simulator()
    starts: SimState = jax.tree.map(jnp.asarray, drawn.starts)
    obstacles, rope = jax.vmap(simulator.obstacles)(starts), simulator.observations(starts).state
    goals: Goal = jax.tree.map(jnp.asarray, drawn.goals)
    everything = Problem(obstacles, rope, goals, numbered(stream(SEED, "bench", "planner"), range(count)))
    return [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], everything) for i in range(count)]


def take_turns(ours: Rrt, ompl: "Ompl", problems: Sequence[Problem]) -> dict[str, list[Found]]:
    """Each planner on each problem, once the first one has been solved to compile everything."""
    planners: dict[str, Callable[[Problem], Found]] = {
        "doojax": partial(solve, ours),
        "ompl": ompl.solve,
    }
    for run in planners.values():
        run(problems[0])
    found: dict[str, list[Found]] = {name: [] for name in planners}
    for problem in problems:
        for name, run in planners.items():
            found[name].append(run(problem))
    return found


def side_by_side(ours: Rrt, ompl: "Ompl", problems: Sequence[Problem]) -> dict[str, list[Found]]:
    """In each round our planner on all problems at once, and OMPL on one after another."""
    everything = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *problems)
    found: dict[str, list[Found]] = {"doojax": [], "ompl": []}
    solve(ours, everything)  # compiles what cuts the batch up
    for number in range(ROUNDS):
        fold = jax.vmap(partial(jax.random.fold_in, data=number))
        found["doojax"].append(solve(ours, eqx.tree_at(lambda p: p.key, everything, replace_fn=fold)))
        each = [ompl.solve(problem) for problem in problems]
        seconds, accepted, extensions, solved = zip(*each, strict=True)
        found["ompl"].append(Found(sum(seconds), sum(accepted), sum(extensions), all(solved)))
    return found


def solve(ours: Rrt, problems: Problem) -> Found:
    """Our planner on a batch of problems."""
    gc.collect()  # OMPL's last tree, which is a cycle of Python objects, is not ours to clear away
    begun = time.perf_counter()
    tree = jax.block_until_ready(search(ours, problems))
    seconds = time.perf_counter() - begun
    starts = len(tree.used)
    accepted, extensions = int(tree.accepted.sum()) - starts, int(tree.used.sum()) - starts
    return Found(seconds, accepted, extensions, bool(tree.solved.all()))


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


def compare_samplers(ours: Rrt, problems: Sequence[Problem]) -> dict[str, np.ndarray]:
    """Extensions until each problem is solved, or the budget, with each way to sample."""
    variants = {
        "rope": (SETTINGS, rope_sample),
        "one point": (SETTINGS, point_sample),
        "one point, thesis": (THESIS, point_sample),
    }
    found = {}
    for name, (settings, sampler) in variants.items():
        variant = Rrt(ours.dynamics, ours.reliability, ours.task, settings, sampler)
        found[name] = np.array([solve(variant, problem).extensions for problem in problems], dtype=float)
    return found


def rate_rows(results: dict[str, list[Found]], **tags: str | int) -> list[Row]:
    """Accepted extensions per second, and how many times OMPL's ours are."""
    rates = {name: np.array([one.accepted / one.seconds for one in found]) for name, found in results.items()}
    rows = [
        _row("extensions_per_s", {"planner": name, **tags}, values, "1/s", np.median)
        for name, values in rates.items()
    ]
    ratio = rates["doojax"] / rates["ompl"]
    return [*rows, _row("extensions_speedup", {**tags, "against": "ompl"}, ratio, "", np.median)]


def solution_rows(task: str, results: dict[str, list[Found]]) -> list[Row]:
    """Seconds to a solution where both planners find one, and the share of problems that each solves."""
    rows = []
    both = [all(one.solved for one in pair) for pair in zip(*results.values(), strict=True)]
    for name, found in results.items():
        tags = {"planner": name, "task": task}
        if any(both):
            seconds = np.array([one.seconds for one in found])
            rows.append(_row("time_to_solution_s", tags, seconds[both], "s", np.median))
        solved = sum(one.solved for one in found)
        rows.append(row("solved", tags, solved / len(found), "", n=len(found)))
    return rows


def sampler_rows(task: str, extensions: dict[str, np.ndarray]) -> list[Row]:
    """Geometric means of the extensions to a solution."""
    return [
        _row("extensions_to_solution", {"task": task, "sample": name}, values, "", _geometric_mean)
        for name, values in extensions.items()
    ]


def _row(
    metric: str, tags: dict[str, Any], values: np.ndarray, unit: str, statistic: Callable[..., Any]
) -> Row:
    found = bootstrap(values, statistic)
    return row(metric, tags, found.value, unit, found.low, found.high, found.n)


def _geometric_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.exp(np.log(values).mean(axis))


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
