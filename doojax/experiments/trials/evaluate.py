"""Trials of several methods on the same scenes: `doojax evaluate`.

The folder of an evaluation holds config.json and, for every method, one record a trial. What is there is not
run again: an evaluation that was killed goes on where it was and loses the trials in flight.
"""

import json
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from doojax.commands import command_line
from doojax.datasets.progress import progress_bar
from doojax.experiments.reports.provenance import digests, note_command
from doojax.experiments.trials.methods import (
    RECIPES,
    find_models,
    make_method,
    needed_models,
    pretrained_models,
)
from doojax.experiments.trials.outcomes import CONFIG, METHOD, SCENES, SECONDS
from doojax.experiments.trials.record_files import save_record
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.scenes import SceneSet, load_scenes, save_scenes, scene_file
from doojax.experiments.trials.seen import Seen, check_unseen, warning_of
from doojax.experiments.trials.setting import Method, Trials, TrialSettings
from doojax.experiments.trials.trial import CRASHED, crashed, run_trials
from doojax.experiments.trials.trial_list import line_of, note_trial
from doojax.files import alone_in, append_line, claim, file_digest
from doojax.keys import check_seed
from doojax.planning import RrtSettings, require_reachable
from doojax.simulation.engines import resolve_engine
from doojax.simulation.state import Simulator
from doojax.simulation.tracking import EXACT, Tracking, tracked
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.tasks.ropes import OWN, OtherRope, carrying

ON_CPU, ON_ACCELERATORS = 8, 32  # trials side by side
MOST_SIDE_BY_SIDE = 4096
PLANNING, BUDGET = RrtSettings(), TrialSettings()


def evaluate(
    task: str,
    /,
    *,
    methods: tuple[str, ...],
    out: Path,
    models: Path | None = None,
    scenes: Path | None = None,
    trials: int | None = None,
    seed: int = 0,
    rope: OtherRope = OWN,
    tracking: Tracking = EXACT,
    engine: str = "auto",
    planning: RrtSettings = PLANNING,
    budget: TrialSettings = BUDGET,
    side_by_side: int | None = None,
    keep_trees: bool = False,
    accept: str | None = None,
    margin: float | None = None,
    arms: bool = False,
    allow_seen: bool = False,
) -> None:
    """Try methods on the same scenes: one record a trial, for doojax compare and doojax view.

    Runs on from where it was killed, to the same trials. Trial i depends on the scenes, its number, the
    seed, the models and the settings alone, so a longer evaluation begins with the same trials.

    Args:
        task: rope_dragging, dual_gripper, watering_2d or toy.
        methods: some of classifier, voxel_classifier, deviation, no_classifier, collision_checker,
            full_dynamics, learned_recovery, random_recovery, oracle, policy; and of models that were adapted,
            which lie in folders of these names: focus, all_data, all_data_no_mde, no_adaptation.
        out: the evaluation's folder; new, empty, or the same evaluation unfinished.
        models: a folder of trained models, or of folders with a model.eqx each; by default those that come
            with doojax. Where there are none, the dynamics are the simulator's own without obstacles.
        scenes: a file that doojax scenes wrote, or the name of a set that comes with doojax, such as
            rope_dragging_dense; by default the one named after the task.
        trials: how many, from the first scene on; by default one for every scene.
        seed: of everything that is random.
        rope: what of the rope differs from the task's own, in all scenes; they may bring one of their own.
        tracking: how far off a robot is that is not exact; goals count as reached where they are in truth.
        engine: that executes: auto, mujoco, mjx or warp.
        planning: how a tree is grown.
        budget: when a trial ends.
        side_by_side: trials in one batch; by default 8 on a CPU and 32 on an accelerator.
        keep_trees: record all that was tried in every search (megabytes a trial).
        accept: conformal:0.05 or conformal:0.1: accept only above the classifier's threshold at which at most
            that fraction of what it accepts was to be wrong; by default what is more likely right than wrong.
            With the method deviation, only where the upper bound that so many exceed is below its limit.
        margin: metres, what the collision checker keeps from obstacles; by default 0.02.
        arms: of dual_gripper, plan only what the dual arm, which stands before the table, can carry out; the
            hands that follow plans are free ones. Trials that arms cannot begin, or whose goals they cannot
            reach, end at once and are not reached.
        allow_seen: go on with scenes that a model saw in training, and mark the results.

    Raises:
        ValueError: for an unknown name, models that are missing or of another task, more trials than scenes,
            a goal that nothing can reach, a folder that holds something else, scenes that a model saw in
            training, or a method all of whose trials crashed.
        BlockingIOError: another process evaluates into the same folder.
    """
    check_seed(seed)
    command = command_line(evaluate, locals())
    make_task(task)  # refuses unknown names
    if not methods:
        raise ValueError(f"no methods were named, expected some of {', '.join(RECIPES)}")
    engine = resolve_engine(engine)
    path = scene_file(scenes, task)
    scene_set = load_scenes(path)
    the_task = make_task(task, crowd=scene_set.crowd)
    found = find_models(models, task) if models else pretrained_models(task)
    needed = {name: needed_models(name, found) for name in dict.fromkeys(methods)}
    seen: dict[str, Seen] = {
        name: check_unseen(scene_set.stream, scene_set.seed, files, allow_seen=allow_seen)
        for name, files in needed.items()
    }
    trials = len(scene_set) if trials is None else trials
    if side_by_side is None:
        side_by_side = ON_CPU if jax.default_backend() == "cpu" else ON_ACCELERATORS
    if not 1 <= side_by_side <= MOST_SIDE_BY_SIDE:
        raise ValueError(f"side_by_side is {side_by_side}, expected 1 to {MOST_SIDE_BY_SIDE}")
    if scene_set.task != task:
        raise ValueError(f"{path} holds scenes of {scene_set.task}, not of {task}")
    if not 1 <= trials <= len(scene_set):
        raise ValueError(f"trials is {trials}, expected 1 to {len(scene_set)}, the number of scenes")
    if rope.given:
        scene_set = with_other_rope(scene_set, the_task, rope)
    config = {
        "task": task,
        **({"rope": scene_set.rope.given} if scene_set.rope.given else {}),
        "scene": the_task.scene.digest,
        "scenes": file_digest(path)[:16],
        "seed": seed,
        "engine": engine,
        "planning": asdict(planning),
        "budget": asdict(budget),
        "side_by_side": side_by_side,
        "accept": accept,
        **({} if margin is None else {"margin": margin}),
        **({"arms": True} if arms else {}),
        **({} if tracking.exact else {"tracking": asdict(tracking)}),
        "allow_seen": allow_seen,
    }
    simulator = the_task.simulator(engine)
    require_reachable(the_task, jax.vmap(simulator.obstacles)(scene_set.starts), scene_set.goals)
    robot = tracked(simulator, tracking)
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    with alone_in(out):
        claim(out, CONFIG, config, "evaluation")
        if not (out / SCENES).exists():
            save_scenes(out / SCENES, scene_set)
        inputs = {f"{name}/{kind}": file for name, files in needed.items() for kind, file in files.items()}
        note_command(out, command, seed, digests({"scenes": path, **inputs}))
        for name, files in needed.items():
            models_used = {kind: file_digest(path)[:16] for kind, path in files.items()}
            about = {"models": models_used, "scenes_seen": seen[name]}
            claim(out / name, METHOD, about, "evaluation")
            if warning := warning_of(seen[name], name):
                console.print(warning, style="yellow")
            method = make_method(name, the_task, simulator, found, accept, margin, arms)
            missing = [i for i in range(trials) if not record_file(out, name, i).exists()]
            groups = sorted({i // side_by_side for i in missing})
            with progress_bar(console) as progress:
                bar = progress.add_task(name, total=trials, completed=trials - len(missing), note="")
                reached, broken = 0, []
                for group in groups:
                    begun = time.perf_counter()
                    numbers = group_of(group, side_by_side, len(scene_set))
                    fresh = [i for i in missing if i // side_by_side == group]
                    wanted = [n in fresh and numbers.index(n) == k for k, n in enumerate(numbers)]
                    chosen = chosen_trials(scene_set, numbers, seed)._replace(wanted=wanted)
                    records = attempted(the_task, robot, method, planning, budget, chosen, keep_trees)
                    for i in fresh:
                        record = records[numbers.index(i)]
                        save_record(record_file(out, name, i), record)
                        note_trial(out / name, line_of(record, i))
                        reached += record.reached
                        broken += [record.end] if record.end.startswith(CRASHED) else []
                    _note_seconds(out / name, len(fresh), time.perf_counter() - begun)
                    progress.update(bar, advance=len(fresh), note=f"{reached} reached")
            if broken:
                said = f"{len(broken)} of {len(missing)} trials of {name} {broken[0]} (their records say "
                said += "where; delete them to try again)"
                if len(broken) == len(missing):
                    raise ValueError(said)
                console.print(said, style="red")
    console.print(f"{trials} trials of {', '.join(needed)} in {out}")
    console.print(f"to see how they did: doojax compare {out}")


def with_other_rope(scenes: SceneSet, task: Task, rope: OtherRope) -> SceneSet:
    """The same scenes with another rope.

    Raises:
        ValueError: the scenes have one of their own, or their starts are none of this rope's.
    """
    if scenes.rope.given:
        raise ValueError(f"the scenes have a rope of their own, {scenes.rope.given}: leave --rope out")
    if rope.reshapes:
        raise ValueError(
            "these scenes start with the task's own rope: draw scenes for one of another length or radius, "
            f"as in: doojax scenes {task.name} --rope.length 0.4"
        )
    return replace(scenes, starts=carrying(task, scenes.starts, rope), rope=rope)


def record_file(out: Path, method: str, trial: int) -> Path:
    """Where a trial's record is."""
    return out / method / f"{trial:05d}.npz"


def group_of(group: int, size: int, scenes: int) -> list[int]:
    """The numbers of the trials of a group: always as many, so that nothing is compiled anew and results do
    not depend on how many trials are asked for; beyond the last scene they begin anew."""
    return [number % scenes for number in range(group * size, (group + 1) * size)]


def chosen_trials(scenes: SceneSet, numbers: Sequence[int], seed: int) -> Trials:
    """The trials with these numbers."""
    rows = np.asarray(numbers)
    starts, goals = jax.tree.map(lambda leaf: leaf[rows], (scenes.starts, scenes.goals))
    return Trials(starts, goals, numbers, seed)


def attempted(
    task: Task,
    simulator: Simulator,
    method: Method,
    planning: RrtSettings,
    budget: TrialSettings,
    trials: Trials,
    keep_trees: bool = False,
) -> list[TrialRecord]:
    """What `run_trials` gives; if it fails, every wanted trial is run without the others, and those that fail
    again are recorded as crashed. Those that are not wanted have records that say no more than that."""
    count = len(trials.numbers)

    def run(some: Trials) -> list[TrialRecord]:
        return run_trials(task, simulator, method, planning, budget, some, keep_trees=keep_trees)

    try:
        return run(trials)
    except Exception as error:
        if count == 1:
            return [crashed(task, simulator, method, trials, error, traceback.format_exc())]
    records = []
    for i, number in enumerate(trials.numbers):
        rows = np.full(count, i)  # as many, and so the same shapes, but only the first runs
        starts, goals = jax.tree.map(lambda leaf, r=rows: leaf[r], (trials.starts, trials.goals))
        first = trials.wanted is None or trials.wanted[i]
        alone = Trials(starts, goals, [number] * count, trials.seed, [first] + [False] * (count - 1))
        try:
            records.append(run(alone)[0])
        except Exception as error:
            records.append(crashed(task, simulator, method, alone, error, traceback.format_exc()))
    return records


def _note_seconds(folder: Path, trials: int, seconds: float) -> None:
    append_line(folder / SECONDS, json.dumps({"trials": trials, "seconds": round(seconds, 3)}))
