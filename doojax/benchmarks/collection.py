"""How long it takes to collect as much data as the thesis used."""

import tempfile
import time
from pathlib import Path

from doojax.benchmarks.rollouts import SEED
from doojax.commands import command_line
from doojax.datasets.collect import SHARD_SIZE, collect
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.tasks import make_task

TRAJECTORIES = {  # the thesis's, by task and phase
    "rope_dragging": {"unconstrained": 6144, "constrained": 2048},
    "dual_gripper": {"unconstrained": 2048, "constrained": 5996},
}


def collection(
    *,
    task: str = "rope_dragging",
    share: float = 1.0,
    keep: Path | None = None,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Collect the thesis's data of both phases, or a share of it, and measure the minutes.

    Args:
        task: rope_dragging or dual_gripper.
        share: of the trajectories that are collected; the minutes are then scaled up to all of them.
        keep: the folder in which the data sets stay, as TASK_PHASE; by default they are deleted.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/simulation; by
            default they are only shown.

    Raises:
        ValueError: for a task of which the thesis has no data, or a share outside (0, 1].
    """
    command = command_line(collection, locals())
    if task not in TRAJECTORIES:
        raise ValueError(f"the thesis has no data of {task!r}, only of {', '.join(TRAJECTORIES)}")
    if not 0 < share <= 1:
        raise ValueError(f"share is {share}, expected more than 0 and at most 1")
    rows = []
    for phase in ("unconstrained", "constrained"):
        wanted = TRAJECTORIES[task][phase]
        made = max(round(wanted * share), SHARD_SIZE)
        states = make_task(task, phase=phase).trajectory_states
        with tempfile.TemporaryDirectory() as temporary:
            folder = (keep or Path(temporary)) / f"{task}_{phase}"
            if folder.exists():
                raise ValueError(f"{folder} is there already: collecting into it would not measure the whole")
            start = time.perf_counter()
            collect(task, phase=phase, trajectories=made, seed=SEED, out=folder)
            minutes = (time.perf_counter() - start) / 60
        tags = {"task": task, "phase": phase, "trajectories": wanted, "states": states, "share": share}
        rows.append(row("collect_minutes", tags, minutes * wanted / made, "min", n=made))
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    show(rows, json)
