"""Many settings of one command, on many processes: `doojax sweep`."""

import csv
import io
import json
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from doojax.datasets.progress import progress_bar
from doojax.experiments.reports.summary import SUMMARY, read_summary
from doojax.experiments.sweeps import executors
from doojax.experiments.sweeps.executors import ExecutorName, Start, Worker
from doojax.experiments.sweeps.spec import OUT, Cell, cells_of, read_spec
from doojax.experiments.sweeps.worker import BEGUN, CELLS, DONE, FAILED, FOLDER, MOST_BEGUN, is_over
from doojax.files import alone_in, write_whole
from doojax.optional import require
from doojax.terminal import labelled, narrow_table

TABLE, PICTURE = "sweep.csv", "sweep.png"
POLL, GRACE = 0.2, 2.0  # s


def sweep(spec: Path, /, *, out: Path, executor: ExecutorName = "local", workers: int | None = None) -> None:
    """Run a command for every value of what a spec varies, and gather what was measured in one table.

    The spec is a YAML file, such as::

        command: >-
          doojax evaluate rope_dragging --methods {method} --seed {seed} --trials 5 --out {out}
          && doojax compare {out} --publish {out}
        grid: {method: [oracle, collision_checker]}
        seeds: 5

    Each cell has a folder of its own, named by a digest of its command, doojax's version and the files that
    it reads. Killed workers are replaced; a sweep that was killed goes on where it was when it is given
    again, and one with more values keeps what is done. A cell that fails is reported, and tried anew next
    time; the others go on.

    Args:
        spec: the file, see `doojax.experiments.sweeps.spec.Spec`.
        out: the sweep's folder: cells/, sweep.csv, a line for every row that a cell published, and their
            figure, sweep.png. Every machine that works for the sweep has to see it.
        executor: local, processes on this machine; ray, a cluster (RAY_ADDRESS says which, or one that runs
            here; without any, one is started here); submitit, jobs of SLURM, which SBATCH_PARTITION,
            SBATCH_TIMELIMIT and the like describe.
        workers: processes, tasks or jobs; by default one for each processor here or of ray's cluster.

    Raises:
        ValueError: a spec that makes no sense, workers below 1, or cells that failed; the message names one.
        BlockingIOError: another sweep runs in the folder.
        ModuleNotFoundError: ray or submitit is missing; the message names the extra.
        ChildProcessError: workers die one after another, as where another machine lacks doojax.
    """
    if workers is not None and workers < 1:
        raise ValueError(f"workers is {workers}, expected at least 1")
    require("matplotlib")  # of the figure: before hours of work rather than after
    cells = cells_of(read_spec(spec))
    out = out.resolve()
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    with alone_in(out):
        for cell in cells:
            for name in (FAILED, BEGUN):  # of a run before
                (out / FOLDER / cell.name / name).unlink(missing_ok=True)
        lines = {cell.name: cell.command(out / FOLDER / cell.name) for cell in cells}
        write_whole(out / CELLS, json.dumps(lines, indent=1))
        with progress_bar(console) as progress:
            bar = progress.add_task("sweep", total=len(cells), note="")

            def report(done: int, failed: int) -> None:
                progress.update(bar, completed=done + failed, note=f"{failed} failed" if failed else "")

            with executors.executor(executor, out) as (start, most):
                supervise(out, cells, workers or most, report, start)
    rows = rows_of(out, cells)
    _write_table(out / TABLE, cells, rows)
    if rows:
        from doojax.experiments.sweeps.picture import draw_sweep_table

        draw_sweep_table(out / PICTURE, list(cells[0].values), rows)
        _show(rows)
        console.print(f"{len(rows)} rows of {len(cells)} cells in {out / TABLE}, drawn in {out / PICTURE}")
    failed = [cell for cell in cells if (out / FOLDER / cell.name / FAILED).exists()]
    if failed:
        folder = out / FOLDER / failed[0].name
        said = json.loads((folder / FAILED).read_text())["error"]
        raise ValueError(f"{len(failed)} of {len(cells)} cells failed, such as {folder}: {said}")


def supervise(
    out: Path,
    cells: Sequence[Cell],
    workers: int,
    report: Callable[[int, int], None],
    start: Start,
) -> None:
    """Keep so many workers at it until every cell is done or has failed; those that died are replaced.

    Raises:
        ChildProcessError: workers die one after another, and no cell gets done.
    """
    running: list[Worker] = []
    over, dead = 0, 0  # cells; workers that died since there were more of these
    try:
        while True:
            folders = [out / FOLDER / cell.name for cell in cells]
            report(
                sum((one / DONE).exists() for one in folders), sum((one / FAILED).exists() for one in folders)
            )
            left = sum(not is_over(folder) for folder in folders)
            if not left:  # workers see that within a moment; those that still wait for a machine do not
                deadline = time.monotonic() + GRACE
                while any(worker.poll() is None for worker in running) and time.monotonic() < deadline:
                    time.sleep(POLL)
                return
            lost = [worker for worker in running if worker.poll() is not None]
            dead = len(lost) + (dead if len(cells) - left == over else 0)
            over = len(cells) - left
            if dead > (MOST_BEGUN + 1) * workers:  # a cell that kills its workers fails before that
                raise ChildProcessError(f"{dead} workers died, and no cell got done: {lost[-1].last_words()}")
            running = [worker for worker in running if worker not in lost]
            while len(running) < min(workers, left):
                running.append(start(out))
            time.sleep(POLL)
    finally:
        for worker in running:
            worker.terminate()
        for worker in running:
            worker.wait()


def rows_of(out: Path, cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """All rows that done cells published below their folders, with the cells' values."""
    found = []
    for cell in cells:
        folder = out / FOLDER / cell.name
        if not (folder / DONE).exists():
            continue
        seconds = json.loads((folder / DONE).read_text())["seconds"]
        common = {"cell": cell.name, **cell.values}
        found.append({**common, "metric": "seconds", "value": seconds, "unit": "s"})
        for file in sorted((folder / OUT).rglob(SUMMARY)):
            for row in read_summary(file).rows:
                tags = json.dumps(dict(row.tags), sort_keys=True)
                measured = {
                    "value": row.value,
                    "low": row.low,
                    "high": row.high,
                    "n": row.n,
                    "unit": row.unit,
                }
                found.append({**common, "metric": row.metric, "tags": tags, **measured})
    return found


def _write_table(path: Path, cells: Sequence[Cell], rows: Sequence[dict[str, Any]]) -> None:
    names = ["cell", *cells[0].values, "metric", "tags", "value", "low", "high", "n", "unit"]
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, text.getvalue())


def _show(rows: Sequence[dict[str, Any]]) -> None:
    """Means over seeds."""
    fixed = ("cell", "seed", "value", "low", "high", "n", "unit")
    groups: dict[tuple[tuple[str, Any], ...], list[float]] = defaultdict(list)
    for row in rows:
        groups[tuple((name, value) for name, value in row.items() if name not in fixed)].append(row["value"])
    table = narrow_table("metric, of what", "mean", "of", title="sweep")
    for key, values in groups.items():
        tags = ", ".join(f"{name} {value}" for name, value in key if name != "metric")
        named = labelled(str(dict(key).get("metric", "")), tags)
        table.add_row(named, f"{np.mean(values):.4g}", str(len(values)))
    Console().print(table)
