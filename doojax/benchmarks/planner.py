"""The planner beside OMPL's control::RRT, which is given the same jitted models, one transition at a time.

A second table tells what the samples of `doojax.planning.metric` are worth beside one point for the whole
rope, which the thesis's released code uses.
"""

import gc
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.benchmarks.ompl_peer import SEED, Found, Ompl
from doojax.benchmarks.planner_rows import rate_rows, sampler_rows, solution_rows
from doojax.benchmarks.stages import stages
from doojax.commands import command_line
from doojax.experiments.reports.provenance import digests
from doojax.experiments.reports.summary import publish_rows, show
from doojax.experiments.trials.methods import find_models, make_method, needed_models, pretrained_models
from doojax.experiments.trials.scenes import draw_scenes
from doojax.keys import numbered, stream
from doojax.models import CollisionChecker
from doojax.planning import Goal, Problem, Rrt, RrtSettings, search
from doojax.planning.metric import point_sample, rope_sample
from doojax.simulation.scenes import parked_poses
from doojax.simulation.state import SimState, at_rest
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.tasks.toy import ToySimulator
from doojax.types import Obstacles, RopeState

SCENES = 20
ROUNDS = 5  # in which all scenes are planned
SETTINGS = RrtSettings()
THESIS = RrtSettings(goal_bias=0.05, duration=49, candidates=1)


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
    show(rows, False)


def problems_of(task: Task, count: int) -> list[Problem]:
    """Batches of one problem each, in scenes of the kind that trials have."""
    drawn, simulator = draw_scenes(task, count, SEED), task.simulator()
    starts: SimState = jax.tree.map(jnp.asarray, drawn.starts)
    obstacles, rope = jax.vmap(simulator.obstacles)(starts), simulator.observations(starts).state
    goals: Goal = jax.tree.map(jnp.asarray, drawn.goals)
    everything = Problem(obstacles, rope, goals, numbered(stream(SEED, "bench", "planner"), range(count)))
    return [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], everything) for i in range(count)]


def take_turns(ours: Rrt, ompl: Ompl, problems: Sequence[Problem]) -> dict[str, list[Found]]:
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


def side_by_side(ours: Rrt, ompl: Ompl, problems: Sequence[Problem]) -> dict[str, list[Found]]:
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
