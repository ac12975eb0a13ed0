"""One learner, one seed: iterations of trials and learning, and what is measured of it on other scenes.

A seed's folder holds ``learning`` (config, figures by iteration: a training run to the viewer), the trials
and models of every iteration in ``iteration_NNN``, the trials of evaluations after so many iterations in
``evaluation_NNN``, and lists: evaluations.jsonl, seconds.jsonl. An iteration that is in ``learning`` is not
done again; what a kill left half done is, to the same bytes.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
from msgspec import Meta

from doojax.experiments.online.learners import Learner
from doojax.experiments.trials.evaluate import attempted, chosen_trials, group_of
from doojax.experiments.trials.record_files import load_record, save_record
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.scenes import SceneSet, draw_scenes
from doojax.experiments.trials.setting import Trials, TrialSettings
from doojax.files import alone_in, append_line
from doojax.learning.runs import RunDirectory
from doojax.planning import RrtSettings
from doojax.reading import read_lines
from doojax.simulation.state import Simulator
from doojax.tasks.base import Task
from doojax.tasks.ropes import OWN, OtherRope, carrying, with_rope

LEARNING, EVALUATIONS, SECONDS = "learning", "evaluations.jsonl", "seconds.jsonl"
PURPOSE = "online"  # of training scenes: no scene set for trials has this stream
TRAINING, HELD_OUT = "online trials", "online evaluation"  # random streams of trials
SIDE_BY_SIDE = 8  # trials of an evaluation

Tell = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Setting:
    """All that an online run depends on, beside learner and seed."""

    task: Task
    simulator: Simulator
    held_out: SceneSet
    episodes: int  # trials of an iteration
    evaluate_every: int  # iterations
    evaluation_trials: int  # scenes of ``held_out``, from the first on
    planning: RrtSettings
    budget: TrialSettings
    rope: OtherRope = OWN  # that is executed
    side_by_side: int = SIDE_BY_SIDE
    about: dict[str, Any] = field(default_factory=dict)  # what else the result depends on, as JSON values
    saw: tuple[dict[str, Any], ...] = ()  # what the models that one begins with learned from

    @property
    def config(self) -> dict[str, Any]:
        """What a folder must agree with to be gone on with; more iterations are the same and more."""
        return {
            "task": self.task.name,
            "scene": self.task.scene.digest,
            "rope": self.rope.given,
            "episodes": self.episodes,
            "held_out": {"stream": self.held_out.stream, "seed": self.held_out.seed},
            "evaluate_every": self.evaluate_every,
            "evaluation_trials": self.evaluation_trials,
            "planning": asdict(self.planning),
            "budget": asdict(self.budget),
            "side_by_side": self.side_by_side,
            **self.about,
        }


@dataclass(frozen=True)
class Evaluation:
    """How trials on held-out scenes went, after so many iterations."""

    iteration: Annotated[int, Meta(ge=0)]
    reached: list[bool]
    final_error_m: list[float]

    @property
    def rate(self) -> float:
        """The share of trials that reached their goals."""
        return float(np.mean(self.reached))


@dataclass(frozen=True)
class Seconds:
    """How long an iteration took."""

    iteration: Annotated[int, Meta(ge=1)]
    trials: Annotated[float, Meta(ge=0)]
    learning: Annotated[float, Meta(ge=0)]
    evaluation: Annotated[float, Meta(ge=0)]


def run_seed(
    folder: Path, setting: Setting, learner: Learner, seed: int, iterations: int, tell: Tell
) -> None:
    """Run a learner up to so many iterations, on from where the folder is; see the module.

    A stationary learner is tried on the held-out scenes, and that is all.

    Args:
        folder: new, empty, or this very run, of as many iterations or fewer or more.
        setting: what is to be done.
        learner: who learns.
        seed: of everything that is random.
        iterations: in all.
        tell: is told of each iteration's figures, and of what a user ought to hear.

    Raises:
        ValueError: for a folder that holds something else, or held-out scenes that it trains on.
        BlockingIOError: another process runs into the same folder.
    """
    if setting.held_out.purpose == PURPOSE:
        raise ValueError(f"the held-out scenes come from {setting.held_out.stream}, from which one trains")
    with alone_in(folder):
        run = RunDirectory.open(
            folder / LEARNING, setting.config | {"method": learner.name, "seed": seed, "what": "online"}
        )
        done = len(run.metrics)
        if not learner.stationary:
            run.forget_after(done)
        known = learner.fresh(seed)
        for iteration in range(1, min(done, iterations) + 1):
            known = learner.taken(known, _records(folder, iteration, setting), seed, iteration).known
        if done and not learner.stationary:
            known = learner.restored(iteration_folder(folder, min(done, iterations)), known)
        latest = evaluated(folder, setting, learner, known, seed, min(done, iterations), tell)
        if learner.stationary or done >= iterations:
            return
        scenes = training_scenes(setting, seed, iterations)
        for iteration in range(done + 1, iterations + 1):
            known, latest = _iterated(
                folder, setting, learner, known, latest, scenes, seed, iteration, run, tell
            )
        learner.save(folder / LEARNING, known, _saw(setting, scenes, seed))


def _iterated(
    folder: Path,
    setting: Setting,
    learner: Learner,
    known: Any,
    latest: Evaluation,
    scenes: SceneSet,
    seed: int,
    iteration: int,
    run: RunDirectory,
    tell: Tell,
) -> tuple[Any, Evaluation]:
    """One iteration: trials, learning, models, and an evaluation if one is due."""
    here, begun = iteration_folder(folder, iteration), time.perf_counter()
    numbers = list(range((iteration - 1) * setting.episodes, iteration * setting.episodes))
    chosen = chosen_trials(scenes, numbers, seed)._replace(purpose=TRAINING)
    records = tried(setting, learner, known, setting.planning, chosen)
    for number, record in enumerate(records):
        save_record(here / f"{number:05d}.npz", record)
    planned = time.perf_counter()
    new = learner.taken(known, records, seed, iteration)
    lesson = learner.learned(new.known, seed, iteration)
    learner.save(here, lesson.known, _saw(setting, scenes, seed))
    learnt = time.perf_counter()
    reached = float(np.mean([record.reached for record in records]))
    if iteration % setting.evaluate_every == 0:
        latest = evaluated(folder, setting, learner, lesson.known, seed, iteration, tell)
    figures = {"success_training": reached, "success_held_out": latest.rate, **new.figures, **lesson.figures}
    seconds = Seconds(iteration, planned - begun, learnt - planned, time.perf_counter() - learnt)
    append_line(folder / SECONDS, json.dumps(asdict(seconds)))
    run.log({"epoch": iteration, **{name: round(float(value), 6) for name, value in figures.items()}})
    for text in (*new.told, *lesson.told):
        tell(f"iteration {iteration}: {text}")
    shown = "  ".join(f"{name} {value:.4g}" for name, value in figures.items())
    tell(f"iteration {iteration}: {shown}")
    return lesson.known, latest


def evaluated(
    folder: Path, setting: Setting, learner: Learner, known: Any, seed: int, iteration: int, tell: Tell
) -> Evaluation:
    """The evaluation after so many iterations, or the last before; made if it is due and not there yet.

    Nothing is accepted by luck in it.
    """
    there = {one.iteration: one for one in evaluations(folder)}
    due = iteration - iteration % setting.evaluate_every
    if due in there:
        return there[due]
    planning = replace(setting.planning, random_accept=0.0)
    records: list[TrialRecord] = []
    for group in range(-(-setting.evaluation_trials // setting.side_by_side)):
        numbers = group_of(group, setting.side_by_side, setting.evaluation_trials)
        wanted = [number == len(records) + place for place, number in enumerate(numbers)]
        chosen = chosen_trials(setting.held_out, numbers, seed)._replace(purpose=HELD_OUT, wanted=wanted)
        found = tried(setting, learner, known, planning, chosen)
        records += [record for record, keep in zip(found, wanted, strict=True) if keep]
    for number, record in enumerate(records):
        save_record(folder / f"evaluation_{iteration:03d}" / f"{number:05d}.npz", record)
    errors = [round(float(record.about["final_error_m"]), 6) for record in records]
    one = Evaluation(iteration, [bool(record.reached) for record in records], errors)
    append_line(folder / EVALUATIONS, json.dumps(asdict(one)))
    tell(f"after iteration {iteration}: {sum(one.reached)} of {len(one.reached)} held-out goals reached")
    return one


def evaluations(folder: Path) -> list[Evaluation]:
    """Those that a seed's folder has, in order; not a line that a kill cut off."""
    found = read_lines(folder / EVALUATIONS, Evaluation, "how an evaluation went")
    return sorted({one.iteration: one for one in found}.values(), key=lambda one: one.iteration)


def iteration_folder(folder: Path, iteration: int) -> Path:
    """Where an iteration's trials and models are."""
    return folder / f"iteration_{iteration:03d}"


def tried(
    setting: Setting, learner: Learner, known: Any, planning: RrtSettings, trials: Trials
) -> list[TrialRecord]:
    """Trials with what a learner knows; their records do not say how long they took, so as to be the same
    bytes when they are made again."""
    method = learner.method(known)
    records = attempted(setting.task, setting.simulator, method, planning, setting.budget, trials)

    def timeless(record: TrialRecord) -> TrialRecord:
        return replace(record, about={k: value for k, value in record.about.items() if k != "plan_s"})

    return [timeless(record) for record in records]


def training_scenes(setting: Setting, seed: int, iterations: int) -> SceneSet:
    """The scenes of all trials that are trained on, from a stream of their own."""
    task, count = setting.task, setting.episodes * iterations
    drawn = draw_scenes(
        with_rope(task, setting.rope), count, seed, setting.held_out.difficulty, purpose=PURPOSE
    )
    starts = jax.tree.map(np.asarray, carrying(task, drawn.starts, setting.rope))
    return replace(drawn, starts=starts, rope=setting.rope)


def _saw(setting: Setting, scenes: SceneSet, seed: int) -> list[dict[str, Any]]:
    return [{"stream": scenes.stream, "seed": seed}, *setting.saw]


def _records(folder: Path, iteration: int, setting: Setting) -> Sequence[TrialRecord]:
    files = [iteration_folder(folder, iteration) / f"{n:05d}.npz" for n in range(setting.episodes)]
    found = [load_record(file) for file in files]
    return [record for record in found if isinstance(record, TrialRecord)]
