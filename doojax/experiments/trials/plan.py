"""One plan: `doojax plan`."""

from dataclasses import replace
from itertools import count
from pathlib import Path

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

from doojax.commands import command_line
from doojax.datasets.progress import announce
from doojax.experiments.reports.provenance import digests
from doojax.experiments.trials.carried import refusals
from doojax.experiments.trials.evaluate import with_other_rope
from doojax.experiments.trials.methods import find_models, make_method, needed_models, pretrained_models
from doojax.experiments.trials.record_files import save_record
from doojax.experiments.trials.scenes import FOLDER, load_scenes
from doojax.experiments.trials.seen import check_unseen, warning_of
from doojax.experiments.trials.setting import Trials, TrialSettings
from doojax.experiments.trials.trial import run_trials
from doojax.experiments.trials.volumes import said_of, volumes_of
from doojax.experiments.trials.why import why
from doojax.keys import check_seed, stream
from doojax.planning import Goal, Problem, RrtSettings, all_of, check_problem
from doojax.simulation.engines import resolve_engine
from doojax.simulation.state import SimState, Simulator
from doojax.tasks import gripper_goal, make_task, point_goal
from doojax.tasks.base import Task
from doojax.tasks.ropes import OWN, OtherRope, carrying, with_rope

PLANS = Path("plans")  # where records go that have no other name
PLANNING, BUDGET = RrtSettings(), TrialSettings()


def plan(
    task: str,
    /,
    *,
    method: str | None = None,
    models: Path | None = None,
    scene: int | None = None,
    seed: int = 0,
    goal: tuple[float, float, float] | None = None,
    points: tuple[int, ...] | None = None,
    grippers: tuple[tuple[float, float, float], ...] | None = None,
    rope: OtherRope = OWN,
    execute: bool = True,
    engine: str = "auto",
    planning: RrtSettings = PLANNING,
    budget: TrialSettings = BUDGET,
    accept: str | None = None,
    margin: float | None = None,
    arms: bool = False,
    allow_seen: bool = False,
    out: Path | None = None,
) -> None:
    """Plan in one scene, execute the plan in the simulator, and record it all for doojax view.

    Args:
        task: rope_dragging, dual_gripper, watering_2d or toy.
        method: one of classifier, voxel_classifier, deviation, no_classifier, collision_checker,
            full_dynamics, learned_recovery, random_recovery, oracle, policy, focus, all_data,
            all_data_no_mde, no_adaptation; by default classifier if there is one.
        models: a folder of trained models, or of folders with a model.eqx each; by default those that come
            with doojax.
        scene: the number of one of the task's scenes for trials; by default a scene drawn by the seed.
        seed: of everything that is random.
        goal: a point (x, y, z, metres) for the task's rope point; by default the scene's.
        points: indices of rope points of which any may reach the goal, in place of the task's own.
        grippers: a point (m) for every gripper; alone, or in addition to a goal.
        rope: what of the rope differs from the task's own.
        execute: false to plan only.
        engine: that executes: auto, mujoco, mjx or warp.
        planning: how a tree is grown.
        budget: when to give up.
        accept: conformal:0.05 or conformal:0.1: accept only above the classifier's threshold at which at most
            that fraction of what it accepts was to be wrong; by default what is more likely right than wrong.
            With the method deviation, only where the upper bound that so many exceed is below its limit.
        margin: metres, what the collision checker keeps from obstacles; by default 0.02.
        arms: of dual_gripper, plan only what the dual arm, which stands before the table, can carry out; the
            hands that follow the plan are free ones.
        allow_seen: plan in a scene that a model saw in training, too.
        out: the record to write, ending in .npz, which must not be there yet; by default the first of
            plans/TASK_METHOD_1.npz, plans/TASK_METHOD_2.npz, ... that is not.

    Raises:
        FileExistsError: there is a record of this name.
        ValueError: for names or indices that do not exist, a goal out of reach, a scene in collision at the
            start, models that are missing or of another task, a scene that a model saw in training, or arms
            that cannot hold the rope where it is, or reach the goal.
    """
    check_seed(seed)
    command = command_line(plan, locals())
    the_task = make_task(task)
    if out is not None and out.suffix != ".npz":
        raise ValueError(f"a record ends in .npz, got {out}")
    if out is not None and out.exists():
        raise FileExistsError(f"{out} is there already: name another record by --out, or delete it")
    if points is not None and goal is None:
        raise ValueError("points were given without a goal that they are to reach")
    found = find_models(models, task) if models else pretrained_models(task)
    method = method or ("classifier" if "classifier" in found else "collision_checker")
    simulator = the_task.simulator(resolve_engine(engine))
    start, aim, origin = _scene(the_task, simulator, scene, seed, rope)
    saw = check_unseen(*origin, needed_models(method, found), allow_seen=allow_seen)
    wanted = [point_goal(the_task, jnp.array(goal), points=points)] if goal is not None else []
    wanted += [gripper_goal(the_task, jnp.array(grippers))] if grippers is not None else []
    aim = all_of(*wanted) if wanted else aim
    batch: tuple[SimState, Goal] = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (start, aim))
    seen = jax.tree.map(lambda leaf: leaf[0], simulator.observations(batch[0]).state)
    check_problem(the_task, Problem(simulator.obstacles(start), seen, aim, stream(seed, "plan")))

    announce(f"planning in {task} with {method}: a minute or so, most of it compiling the first time")
    chosen = make_method(method, the_task, simulator, found, accept, margin, arms)
    if chosen.arms is not None:
        here = jax.tree.map(lambda leaf: leaf[None], (simulator.obstacles(start), seen, aim))
        (refused,) = refusals(chosen.arms, the_task, *here)
        if refused:
            raise ValueError(refused)
    trials = Trials(*batch, [scene or 0], seed)
    (record,) = run_trials(
        the_task, simulator, chosen, planning, budget, trials, keep_trees=True, execute=execute
    )
    about = {"command": command, "rope": rope.given, "inputs": digests(needed_models(method, found))}
    out = out or free_name(PLANS / f"{task}_{method}.npz")
    save_record(out, replace(record, about={**record.about, **about}))
    table = Table(show_header=False, title=f"{task}, {method}, seed {seed}")
    for event in record.events:
        table.add_row(f"state {event.step}", event.kind, event.text)
    console = Console(markup=False, highlight=False)
    console.print(table)
    if warning := warning_of(saw, method):
        console.print(warning, style="yellow")
    if execute:
        what = record.look.what
        ends = f"the {what} ends {100 * record.about['final_error_m']:.1f} cm from the goal"
        ends = said_of(*volumes_of(record)[-1]) if what == "container" else ends
        console.print(ends, highlight=False)
        console.print(f"why: {why(record)}", soft_wrap=True)
    console.print(f"searching took {record.about['plan_s']:.1f} s; to see it all: doojax view {out}")


def free_name(path: Path) -> Path:
    """The first of NAME_1.npz, NAME_2.npz, ... that is not there yet."""
    numbered = (path.with_stem(f"{path.stem}_{number}") for number in count(1))
    return next(one for one in numbered if not one.exists())


def _scene(
    task: Task, simulator: Simulator, scene: int | None, seed: int, rope: OtherRope
) -> tuple[SimState, Goal, tuple[str, int]]:
    """A start, the goal that goes with it, and the random stream and seed that they were drawn from."""
    if scene is None:
        start_key, goal_key = (stream(seed, "plan", name) for name in ("start", "goal"))
        begin = with_rope(task, rope).simulator("mujoco") if rope.given else simulator
        alone = jax.tree.map(lambda leaf: leaf[None], begin.reset(start_key))
        start = jax.tree.map(lambda leaf: leaf[0], carrying(task, alone, rope))
        goal = task.sample_goal(goal_key, simulator.obstacles(start))
        return start, goal, ("plan", seed)
    known = load_scenes(FOLDER / f"{task.name}.scenes")
    if not 0 <= scene < len(known):
        raise ValueError(f"there is no scene {scene} of {task.name}: expected 0 to {len(known) - 1}")
    known = with_other_rope(known, task, rope) if rope.given else known
    chosen = jax.tree.map(lambda leaf: jnp.asarray(leaf[scene]), (known.starts, known.goals))
    return *chosen, (known.stream, known.seed)
