"""`doojax online`."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from doojax.commands import command_line
from doojax.datasets.progress import progress_bar
from doojax.experiments.online.experience import Enrichment
from doojax.experiments.online.focus import FocusLearner, FocusSettings
from doojax.experiments.online.learners import Learner, Stationary
from doojax.experiments.online.reliability import ReliabilityLearner, ReliabilitySettings
from doojax.experiments.online.runner import Setting, run_seed
from doojax.experiments.online.summary import SEED, draw_success, read_curves, rows_of, table_of
from doojax.experiments.reports.provenance import digests
from doojax.experiments.reports.summary import publish_rows
from doojax.experiments.trials.evaluate import with_other_rope
from doojax.experiments.trials.methods import find_models, make_method, pretrained_models
from doojax.experiments.trials.scenes import load_scenes, scene_file
from doojax.experiments.trials.seen import check_unseen, warning_of
from doojax.experiments.trials.setting import TrialSettings
from doojax.files import file_digest
from doojax.keys import check_seed
from doojax.learning.adaptation import AdaptationMethod
from doojax.learning.checkpoints import load_model, own_threshold
from doojax.learning.provenance import SAW
from doojax.planning import RrtSettings, require_reachable
from doojax.planning.recovery import RandomRecovery
from doojax.simulation.engines import resolve_engine
from doojax.simulation.state import Simulator
from doojax.simulation.tracking import EXACT, Tracking, tracked
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.tasks.ropes import OWN, OtherRope

RELIABILITY: dict[str, Enrichment] = {
    "classifier": "none",
    "classifier_augmented": "augmentation",
    "classifier_noise": "noise",
}
ADAPTED: dict[str, tuple[AdaptationMethod, bool]] = {  # how data are weighed, and is deviation estimated?
    "focus": ("focus", True),
    "all_data": ("all_data", True),
    "all_data_no_mde": ("all_data", False),
}
STATIONARY = ("no_classifier", "collision_checker", "oracle")
METHODS = (*RELIABILITY, *ADAPTED, *STATIONARY)
PLANNING = RrtSettings(random_accept=0.01)
BUDGET = TrialSettings(searches=4, actions=100)
LEARNING, ADAPTING = ReliabilitySettings(), FocusSettings()
FIGURE = "success.png"


def online(
    task: str,
    /,
    *,
    methods: tuple[str, ...],
    out: Path,
    iterations: int = 50,
    episodes: int = 1,
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4),
    evaluate_every: int = 10,
    evaluation_trials: int = 16,
    scenes: Path | None = None,
    models: Path | None = None,
    threshold: float | None = None,
    rope: OtherRope = OWN,
    tracking: Tracking = EXACT,
    engine: str = "auto",
    planning: RrtSettings = PLANNING,
    budget: TrialSettings = BUDGET,
    learning: ReliabilitySettings = LEARNING,
    adapting: FocusSettings = ADAPTING,
    publish: Path | None = None,
) -> None:
    """Learn from one's own trials, again and again, and measure success on scenes that are not learned from.

    Killed, it goes on where it was when the same command is given again, to the same trials and models; more
    iterations, seeds or methods are the same and more. Training scenes come from a random stream of their
    own; in evaluations nothing is accepted by luck.

    Args:
        task: rope_dragging, dual_gripper, engine_bay or toy.
        methods: some of classifier (learns from nothing, dynamics stay), classifier_augmented (and from
            augmentations of its examples), classifier_noise (and from noisy copies); of focus, all_data,
            all_data_no_mde, whose dynamics adapt to the rope that is executed; and of those that learn
            nothing and are evaluated once: no_classifier, collision_checker, oracle.
        out: the folder; new, empty, or the same experiment unfinished.
        iterations: of trials and learning, in all.
        episodes: trials of an iteration.
        seeds: of everything that is random; each is a run of its own.
        evaluate_every: iterations between two evaluations; the first comes before all learning.
        evaluation_trials: scenes of an evaluation, the first ones of the set.
        scenes: held-out scenes: a file that doojax scenes wrote, or the name of a set that comes with doojax;
            by default the one named after the task.
        models: a folder with trained dynamics; by default those that come with doojax.
        threshold: of the model error (m) below which a prediction counts as right, or is to be for a plan to
            use it; by default the one that was found when the dynamics were trained.
        rope: what of the rope differs from the task's own, in all scenes.
        tracking: how far off a robot is that is not exact; goals count as reached where they are in truth.
        engine: that executes: auto, mujoco, mjx or warp.
        planning: how a tree is grown.
        budget: when a trial ends.
        learning: how classifiers learn.
        adapting: how dynamics adapt, and how the estimator of their deviation learns.
        publish: the folder of results whose summary.json gets the figures; by default they are only shown.

    Raises:
        ValueError: for an unknown method or task, counts below 1, models that are missing or saw the held-out
            scenes, a goal that nothing can reach, or a folder that holds something else.
        BlockingIOError: another process runs the same method and seed into the same folder.
    """
    command = command_line(online, locals())
    _check(methods, iterations, episodes, seeds, evaluate_every)
    engine = resolve_engine(engine)
    path = scene_file(scenes, task)
    held_out = load_scenes(path)
    the_task = make_task(task, crowd=held_out.crowd)
    if held_out.task != task:
        raise ValueError(f"{path} holds scenes of {held_out.task}, not of {task}")
    if not 1 <= evaluation_trials <= len(held_out):
        raise ValueError(
            f"evaluation_trials is {evaluation_trials}, expected 1 to {len(held_out)}, the scenes"
        )
    if rope.given:
        held_out = with_other_rope(held_out, the_task, rope)
    found = find_models(models, task) if models else pretrained_models(task)
    found = {kind: file for kind, file in found.items() if kind == "dynamics"}
    warning = warning_of(check_unseen(held_out.stream, held_out.seed, found), "what it begins with")
    simulator = the_task.simulator(engine)
    require_reachable(the_task, jax.vmap(simulator.obstacles)(held_out.starts), held_out.goals)
    learners = [
        _learner(name, the_task, simulator, found, threshold, budget, learning, adapting)
        for name in dict.fromkeys(methods)
    ]
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    if warning:
        console.print(warning, style="yellow")
    for learner in learners:
        about: dict[str, Any] = {"engine": engine, "scenes": file_digest(path)[:16]}
        about["models"] = {kind: file_digest(file)[:16] for kind, file in found.items()}
        if not learner.stationary:
            own = adapting if learner.name in ADAPTED else learning
            about |= {"learning": asdict(own), "threshold": threshold}
        if not tracking.exact:
            about["tracking"] = asdict(tracking)
        saw = tuple(load_model(file)[1].about.get(SAW, []) for file in found.values())
        setting = Setting(
            task=the_task,
            simulator=tracked(simulator, tracking),
            held_out=held_out,
            episodes=episodes,
            evaluate_every=evaluate_every,
            evaluation_trials=evaluation_trials,
            planning=planning,
            budget=budget,
            rope=rope,
            about=about,
            saw=tuple(entry for entries in saw for entry in entries),
        )
        with progress_bar(console) as progress:
            for seed in seeds:
                bar = progress.add_task(f"{learner.name}, seed {seed}", total=iterations, note="")

                def tell(text: str, name: str = f"{learner.name}, seed {seed}", bar: Any = bar) -> None:
                    console.print(f"{name}, {text}")
                    number = text.removeprefix("iteration ").split(":")[0]
                    if number.isdecimal():
                        progress.update(bar, completed=int(number))

                run_seed(out / learner.name / f"{SEED}{seed}", setting, learner, seed, iterations, tell)
                progress.update(bar, completed=iterations)
    curves = read_curves(out)
    draw_success(out / FIGURE, task, curves)
    Console().print(table_of(task, curves))
    console.print(f"{out / FIGURE} is drawn; trials and curves: doojax view {out}")
    wanted = [curve for curve in curves if curve.method in methods]
    rows = [one for curve in wanted for one in rows_of(task, curve)]
    inputs = digests({"scenes": path, **found})
    publish_rows(publish, command=command, seed=None, rows=rows, inputs=inputs)


def _check(
    methods: tuple[str, ...], iterations: int, episodes: int, seeds: tuple[int, ...], evaluate_every: int
) -> None:
    unknown = [name for name in methods if name not in METHODS]
    if unknown or not methods:
        raise ValueError(f"methods are {', '.join(methods) or 'none'}, expected some of {', '.join(METHODS)}")
    if not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds are {seeds}, expected one or more, none of them twice")
    for seed in seeds:
        check_seed(seed)
    counts = {"iterations": iterations, "episodes": episodes, "evaluate_every": evaluate_every}
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name} is {count}, expected at least 1")


def _learner(
    name: str,
    task: Task,
    simulator: Simulator,
    models: dict[str, Path],
    threshold: float | None,
    budget: TrialSettings,
    learning: ReliabilitySettings,
    adapting: FocusSettings,
) -> Learner:
    """The learner called ``name``."""
    if name in STATIONARY:
        planned = make_method(name, task, simulator, models)
        return Stationary(replace(planned, recovery=RandomRecovery()))
    if "dynamics" not in models:
        raise ValueError(
            f"{name} begins with trained dynamics, and there are none for {task.name}: train them with "
            "doojax train dynamics, and name their folder by --models"
        )
    dynamics, header = load_model(models["dynamics"], task=task.name, kind="dynamics")
    error = own_threshold(header, models["dynamics"]) if threshold is None else threshold
    if not error > 0:
        raise ValueError(f"threshold is {threshold}, expected a positive length (m)")
    if name in ADAPTED:
        weighing, estimated = ADAPTED[name]
        gamma = own_threshold(header, models["dynamics"])
        config = dict(header.config)
        return FocusLearner(name, task, dynamics, config, gamma, error, weighing, estimated, adapting)
    return ReliabilityLearner(name, task, dynamics, error, budget.actions, RELIABILITY[name], learning)
