"""`doojax regrasp`: trials of several methods in the same scenes, and a table of them."""

from dataclasses import asdict
from pathlib import Path
from typing import Literal, get_args

from rich.console import Console

from doojax.commands import command_line
from doojax.datasets.progress import progress_bar
from doojax.experiments.regrasping.choice import Method
from doojax.experiments.regrasping.figures import rows_of
from doojax.experiments.regrasping.trial import RegraspSettings, run_trial
from doojax.experiments.reports.provenance import note_command
from doojax.experiments.reports.summary import publish_rows, show
from doojax.experiments.trials.record_files import load_record, save_record
from doojax.experiments.trials.records import TrialRecord
from doojax.files import alone_in, claim
from doojax.keys import check_seed
from doojax.tasks.arms import ArmTask, drawn_start
from doojax.tasks.pulling import pulling
from doojax.tasks.untangling import untangling

ENVIRONMENTS = {"pulling": pulling, "untangling": untangling}
CONFIG = "config.json"
SETTINGS = RegraspSettings()


def regrasp(
    environment: Literal["pulling", "untangling"],
    /,
    *,
    out: Path,
    methods: tuple[Method, ...] = ("signature",),
    scenes: int = 3,
    seed: int = 0,
    settings: RegraspSettings = SETTINGS,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Bring a rope's end to a place with two arms that regrasp, in one scene after the other.

    Runs on from where it was killed, to the same trials. Trial i depends on its number, the seed and the
    settings alone, so more scenes begin with the same trials.

    Args:
        environment: pulling (a hose on the floor) or untangling (a cable in a rack).
        out: the folder of the trials' records; new, empty, or the same trials unfinished.
        methods: some of signature, no_signature, always_blocklist, nearest.
        scenes: how many.
        seed: of scenes and of all that is drawn in trials.
        settings: of control, trap detection and grasp planning.
        json: print the figures as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/regrasping; by
            default they are only shown.

    Raises:
        ValueError: for an unknown name, fewer than one scene, or a folder that holds something else.
        BlockingIOError: another process runs trials into the same folder.
    """
    command = command_line(regrasp, locals())
    check_seed(seed)
    if environment not in ENVIRONMENTS:
        raise ValueError(f"unknown environment {environment!r}, expected one of {', '.join(ENVIRONMENTS)}")
    for method in methods:
        if method not in get_args(Method):
            raise ValueError(f"unknown method {method!r}, expected some of {', '.join(get_args(Method))}")
    if not methods or scenes < 1:
        raise ValueError(f"there are {len(methods)} methods and {scenes} scenes, expected 1 or more of both")
    task = ENVIRONMENTS[environment]()
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    with alone_in(out):
        claim(out, CONFIG, config_of(task, seed, settings), "folder of trials")
        note_command(out, command, seed, {})
        records = run_missing(task, methods, scenes, seed, settings, out, console)
    rows = rows_of(environment, records)
    publish_rows(publish, command=command, seed=seed, rows=rows)
    show(rows, json)


def config_of(task: ArmTask, seed: int, settings: RegraspSettings) -> dict:
    """All that determines the trials."""
    return {"task": task.name, "scene": task.scene.digest, "seed": seed, "settings": asdict(settings)}


def record_file(out: Path, method: str, number: int) -> Path:
    """Where a trial's record is."""
    return out / method / f"{number:05d}.npz"


def run_missing(
    task: ArmTask,
    methods: tuple[Method, ...],
    scenes: int,
    seed: int,
    settings: RegraspSettings,
    out: Path,
    console: Console,
) -> dict[str, list[TrialRecord]]:
    """All trials' records, by method: those that are missing are run, scene by scene."""
    methods = tuple(dict.fromkeys(methods))
    simulator = task.simulator()
    with progress_bar(console) as progress:
        bar = progress.add_task(task.name, total=scenes * len(methods), note="")
        for number in range(scenes):
            missing = [one for one in methods if not record_file(out, one, number).exists()]
            start = drawn_start(task, simulator, seed, number) if missing else None
            for method in methods:
                if method in missing and start is not None:
                    record = run_trial(task, simulator, start, method, seed, number, settings)
                    file = record_file(out, method, number)
                    file.parent.mkdir(parents=True, exist_ok=True)
                    save_record(file, record)
                    console.print(f"scene {number}, {method}: {record.end}")
                progress.update(bar, advance=1)
    found: dict[str, list[TrialRecord]] = {}
    for method in methods:
        for number in range(scenes):
            record = load_record(record_file(out, method, number))
            if not isinstance(record, TrialRecord):
                raise ValueError(f"{record_file(out, method, number)} is no trial")
            found.setdefault(method, []).append(record)
    return found
