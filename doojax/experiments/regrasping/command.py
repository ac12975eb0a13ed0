"""`doojax regrasp`: trials of several methods in the same scenes, and a table of them.

A folder of trials holds config.json and, for every method, one record a trial and what it took on the wall.
What is there is not run again; records of one command are the same bytes whenever and in how many goes they
are made.
"""

import json
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from rich.console import Console

from doojax.commands import command_line
from doojax.datasets.progress import progress_bar
from doojax.experiments.regrasping.choice import Method
from doojax.experiments.regrasping.figures import rows_of
from doojax.experiments.regrasping.run import RegraspSettings, Seconds
from doojax.experiments.regrasping.scenes import (
    COUNTS,
    ArmScenes,
    arm_scene_file,
    load_arm_scenes,
    regrasp_scenes,
    task_of,
)
from doojax.experiments.regrasping.trial import Trial, check_method, methods_of, run_trial
from doojax.experiments.reports.provenance import digests, note_command
from doojax.experiments.reports.summary import publish_rows, show
from doojax.experiments.trials.record_files import load_record, save_record
from doojax.experiments.trials.records import TrialRecord
from doojax.files import alone_in, claim, file_digest, write_whole
from doojax.keys import check_seed
from doojax.reading import read_json
from doojax.tasks.arms import ArmTask

CONFIG, DRAWN = "config.json", "drawn.scenes"
SETTINGS = RegraspSettings()


def regrasp(
    environment: Literal["pulling", "untangling", "threading"],
    /,
    *,
    out: Path,
    methods: tuple[str, ...] = ("signature",),
    scenes: tuple[int, ...] = (),
    scene_set: Path | None = None,
    seed: int = 0,
    settings: RegraspSettings = SETTINGS,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Bring a rope's end to a place with two arms that regrasp, in one scene after the other.

    Runs on from where it was killed, to the same trials. Trial i depends on its scene, its number, the seed
    and the settings alone, so more scenes begin with the same trials. Several processes may work in one
    folder, if each runs other methods; one process runs a trial after the other.

    Args:
        environment: pulling (a hose on the floor), untangling (a cable in a rack) or threading (a cable
            through three fixtures).
        out: the folder of the trials' records; new, empty, or the same trials unfinished.
        methods: of pulling and untangling some of signature, always_blocklist, no_signature, tamp5, tamp50,
            nearest; of threading some of signature, no_signature, tamp5, tamp50, wang, nearest. Others are
            compared with the first.
        scenes: how many, from the first on: one number, or one for each method; by default all.
        scene_set: a file that doojax regrasp-scenes wrote; by default the one that comes with doojax, or
            where none does, scenes that are drawn with this seed into the folder.
        seed: of all that is drawn in trials.
        settings: of control, trap detection and grasp planning.
        json: print the figures as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/regrasping; by
            default they are only shown.

    Raises:
        ValueError: for an unknown name, no methods or scenes, more scenes than there are, or a folder that
            holds something else.
        BlockingIOError: another process draws scenes into the same folder, or runs trials of one of the
            methods.
    """
    command = command_line(regrasp, locals())
    check_seed(seed)
    task = task_of(environment)
    named: tuple[Method, ...] = tuple(dict.fromkeys([check_method(task, one) for one in methods]))
    if not named:
        raise ValueError(f"no methods were named, expected some of {', '.join(methods_of(task))}")
    file, given = arm_scene_file(scene_set, task), None
    if file is None:
        file, which = out / DRAWN, f"drawn with seed {seed}"
    else:
        given, which = load_arm_scenes(file, task), file_digest(file)[:16]
    counts = counts_of(named, scenes, COUNTS[task.name] if given is None else len(given))
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    with alone_in(out):
        claim(out, CONFIG, config_of(task, which, seed, settings), "folder of trials")
        drawn = given or drawn_scenes(file, task, max(counts.values()), seed)
        note_command(out, command, seed, digests({"scenes": file}))
    with ExitStack() as stack:
        for one in named:
            stack.enter_context(alone_in(out / one))
        trials = run_missing(task, drawn, counts, seed, settings, out, console)
    rows = rows_of(environment, trials)
    publish_rows(publish, command=command, seed=seed, rows=rows, inputs=digests({"scenes": file}))
    show(rows, json)


def drawn_scenes(file: Path, task: ArmTask, count: int, seed: int) -> ArmScenes:
    """At least so many scenes: those in the file, or new ones into it, which begin with the same."""
    if not file.exists() or len(load_arm_scenes(file, task)) < count:
        regrasp_scenes(task.name, out=file, count=count, seed=seed)
    return load_arm_scenes(file, task)


def counts_of(methods: tuple[Method, ...], scenes: tuple[int, ...], most: int) -> dict[Method, int]:
    """How many scenes each method is tried in.

    Raises:
        ValueError: there are neither one number, nor one for each method, or a number is none of scenes.
    """
    scenes = scenes or (most,)
    if len(scenes) not in (1, len(methods)):
        raise ValueError(
            f"scenes are {', '.join(map(str, scenes))}: expected one number, or one for each of "
            f"{len(methods)} methods"
        )
    for count in scenes:
        if not 1 <= count <= most:
            raise ValueError(f"scenes is {count}, expected 1 to {most}, the number of scenes in the file")
    return dict(zip(methods, scenes * len(methods) if len(scenes) == 1 else scenes, strict=True))


def config_of(task: ArmTask, scenes: str, seed: int, settings: RegraspSettings) -> dict:
    """All that determines the trials."""
    return {
        "task": task.name,
        "scene": task.scene.digest,
        "scenes": scenes,
        "seed": seed,
        "settings": asdict(settings),
    }


def record_file(out: Path, method: str, number: int) -> Path:
    """Where a trial's record is."""
    return out / method / f"{number:05d}.npz"


def seconds_file(out: Path, method: str, number: int) -> Path:
    """Where it is written down what a trial took."""
    return out / method / f"{number:05d}.seconds.json"


def run_missing(
    task: ArmTask,
    scenes: ArmScenes,
    counts: dict[Method, int],
    seed: int,
    settings: RegraspSettings,
    out: Path,
    console: Console,
) -> dict[str, list[Trial]]:
    """All trials, by method: those that are missing are run, scene by scene."""
    simulator = task.simulator()
    with progress_bar(console) as progress:
        bar = progress.add_task(task.name, total=sum(counts.values()), note="")
        for number in range(max(counts.values())):
            wanted: list[Method] = [one for one, count in counts.items() if number < count]
            for method in wanted:
                file = record_file(out, method, number)
                if not file.exists():
                    trial = run_trial(task, simulator, scenes.start(number), method, seed, number, settings)
                    # a record says that a trial is done, so it comes last
                    write_whole(seconds_file(out, method, number), to_json(trial.seconds))
                    save_record(file, trial.record)
                    console.print(f"scene {number}, {method}: {trial.record.end}")
                progress.update(bar, advance=1)
    return {one: [load_trial(out, one, number) for number in range(counts[one])] for one in counts}


def load_trial(out: Path, method: str, number: int) -> Trial:
    """A trial that was run.

    Raises:
        FileNotFoundError: a file of it is missing.
        ValueError: a file of it is something else.
    """
    file = record_file(out, method, number)
    record = load_record(file)
    if not isinstance(record, TrialRecord):
        raise ValueError(f"{file} is no trial")
    return Trial(record, read_json(seconds_file(out, method, number), Seconds, "what a trial took"))


def to_json(seconds: Seconds) -> str:
    """For a file."""
    return json.dumps(asdict(seconds)) + "\n"
