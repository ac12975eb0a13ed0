"""What a user notices first: the size of the wheel, how soon it is imported, how fast cells of a sweep go."""

import os
import resource
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from json import dumps
from pathlib import Path
from typing import get_args

import numpy as np

from doojax.benchmarks.medians import median_row
from doojax.commands import command_line
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.experiments.sweeps.command import sweep
from doojax.experiments.sweeps.executors import ExecutorName

MODULES = ("doojax", "doojax.tasks", "doojax.geometry", "doojax.topology", "doojax.planning")
SOURCES = Path(__file__).parents[2]
CELL = "doojax scenes toy --count 1 --seed {seed} --out {out}/toy.scenes"


def package(
    *, repeats: int = 7, cells: int = 100, workers: int = 2, json: bool = False, publish: Path | None = None
) -> None:
    """Measure import times, the wheel's size, and how many small cells of a sweep end in a minute.

    An import is measured in a fresh interpreter, in seconds of the processor, so that other programs that run
    beside do not count. Of the sweep's executors, those are measured that are installed; on a machine alone,
    that is what they cost.

    Args:
        repeats: of each import.
        cells: of the sweep, each of which draws one scene of the task toy.
        workers: of the sweep.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/ecosystem; by
            default they are only shown.

    Raises:
        FileNotFoundError: doojax was installed without its sources, of which a wheel could be built.
    """
    command = command_line(package, locals())
    here: list[ExecutorName] = [name for name in get_args(ExecutorName) if name == "local" or find_spec(name)]
    sweeps = [sweep_row(name, cells, workers) for name in here]
    rows = [*import_rows(repeats), wheel_row(), *sweeps]
    publish_rows(publish, command=command, seed=None, rows=rows)
    show(rows, json)


def import_rows(repeats: int) -> list[Row]:
    """Seconds of the processor that a fresh interpreter takes for an import, beyond its own start."""
    bare = float(np.median([_seconds("pass") for _ in range(repeats)]))
    return [
        median_row(
            "import_s",
            {"module": module},
            np.array([_seconds(f"import {module}") - bare for _ in range(repeats)]),
            "s",
        )
        for module in MODULES
    ]


def wheel_row() -> Row:
    """The size of the wheel that these sources make.

    Raises:
        FileNotFoundError: there are none.
    """
    if not (SOURCES / "pyproject.toml").exists():
        raise FileNotFoundError(f"there is no pyproject.toml in {SOURCES}: run this in a clone of doojax")
    with tempfile.TemporaryDirectory() as folder:
        build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
        subprocess.run(build, cwd=SOURCES, check=True, capture_output=True)
        (wheel,) = Path(folder).glob("*.whl")
        return row("wheel_mb", {}, wheel.stat().st_size / 1e6, "MB")


def sweep_row(executor: ExecutorName, cells: int, workers: int) -> Row:
    """Cells a minute of a whole `doojax sweep` on this machine, its start and its table included."""
    with tempfile.TemporaryDirectory() as folder:
        spec = Path(folder) / "spec.yaml"
        spec.write_text(dumps({"command": CELL, "seeds": cells}))  # JSON is YAML
        began = time.perf_counter()
        sweep(spec, out=Path(folder) / "sweep", executor=executor, workers=workers)
        minutes = (time.perf_counter() - began) / 60
    tags = {"executor": executor, "workers": workers}
    return row("sweep_cells_per_min", tags, cells / minutes, "1/min", n=cells)


def _seconds(code: str) -> float:
    """Of the processor, user's and system's."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
