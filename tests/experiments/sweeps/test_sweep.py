"""Sweeps: which cells there are, and that none is lost where workers or the driver are killed."""

import contextlib
import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from doojax.commands import call, parsed
from doojax.experiments.reports.prose import commands_of
from doojax.experiments.sweeps.command import _show, rows_of, supervise, sweep
from doojax.experiments.sweeps.executors import Process, start_process
from doojax.experiments.sweeps.spec import Cell, Spec, cells_of, read_spec
from doojax.experiments.sweeps.worker import CELLS, DONE, FAILED, FOLDER, MOST_BEGUN, work

from .naps import NAP

# Workers that know it.
PATCHED = """
import sys
from pathlib import Path
sys.path.insert(0, {folder!r})
import doojax.commands
doojax.commands.COMMANDS = {{"nap": ("nap:nap", "sleep")}}
"""
WORK = PATCHED + "from doojax.experiments.sweeps.worker import work\nwork(Path(sys.argv[1]))"
DRIVE = (
    PATCHED
    + """
import subprocess
from doojax.experiments.sweeps import command, executors
executors.WORKER = (sys.executable, "-c", {work!r})
command.sweep(Path(sys.argv[1]), out=Path(sys.argv[2]), workers=2)
"""
)


@pytest.fixture
def napping(tmp_path, monkeypatch):
    """How a worker is started that knows the command, in a folder of its own."""
    (tmp_path / "nap.py").write_text(NAP)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("doojax.commands.COMMANDS", {"nap": ("nap:nap", "sleep")})
    code = WORK.format(folder=str(tmp_path))
    return lambda out: Process([sys.executable, "-c", code, str(out)])


def prepared(out: Path, count: int, options: str = "") -> list[Cell]:
    """Cells of naps, written down for workers."""
    cells = cells_of(Spec(f"doojax nap {{who}} --out {{out}} {options}", {"who": [*range(count)]}))
    out.mkdir(exist_ok=True)
    (out / CELLS).write_text(json.dumps({c.name: c.command(out / FOLDER / c.name) for c in cells}))
    return cells


def times_begun(out: Path, cells: list[Cell]) -> list[int]:
    return [len((out / FOLDER / cell.name / "out/who").read_text().splitlines()) for cell in cells]


def survives_a_killed_worker(out: Path, start, count: int) -> None:
    cells, workers, killed = prepared(out, count), [], []

    def started(folder):
        workers.append(start(folder))
        return workers[-1]

    def report(done, failed):
        if done >= 2 and not killed:
            killed.append(workers[0])
            workers[0].kill()

    try:
        supervise(out, cells, 2, report, started)
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()
    assert killed and all((out / FOLDER / cell.name / DONE).exists() for cell in cells)
    assert len(rows_of(out, cells)) == count
    assert sum(times_begun(out, cells)) <= count + 1  # but for the one that was killed, each once


def test_a_killed_worker_loses_nothing(napping, tmp_path):
    survives_a_killed_worker(tmp_path / "out", napping, 10)


def survives_killed_drivers(folder: Path, count: int, kills: int) -> None:
    """Drivers are killed, one after another, while their workers go on; the last one ends the sweep."""
    out, spec = folder / "out", folder / "spec.yaml"
    spec.write_text(f"command: doojax nap {{who}} --out {{out}}\ngrid: {{who: {[*range(count)]}}}\n")
    code = DRIVE.format(folder=str(folder), work=WORK.format(folder=str(folder)))
    command = [sys.executable, "-c", code, str(spec), str(out)]
    killed = []
    try:
        for number in range(kills):
            killed.append(subprocess.Popen(command, start_new_session=True))
            deadline = time.monotonic() + 60
            wanted = 2 + number * count // (2 * kills)
            while len(list(out.glob(f"{FOLDER}/*/{DONE}"))) < wanted and time.monotonic() < deadline:
                time.sleep(0.02)
            killed[-1].kill()  # its workers go on
            killed[-1].wait()
        last = subprocess.run(command, capture_output=True, text=True, timeout=100 + count)
    finally:
        for driver in killed:
            with contextlib.suppress(ProcessLookupError):  # all have ended
                os.killpg(driver.pid, signal.SIGKILL)
    assert last.returncode == 0, last.stderr
    assert times_begun(out, cells_of(read_spec(spec))) == [1] * count
    lines = (out / "sweep.csv").read_text().splitlines()
    assert (out / "sweep.png").read_bytes().startswith(b"\x89PNG")
    assert lines[0].startswith("cell,who,metric") and len(lines) == count + 1


def test_a_killed_driver_goes_on_where_it_was(napping, tmp_path):
    survives_killed_drivers(tmp_path, 8, kills=1)


@pytest.mark.slow
def test_a_hundred_cells_survive_killed_workers_and_drivers(napping, tmp_path):
    survives_a_killed_worker(tmp_path / "out", napping, 100)
    (tmp_path / "drivers").mkdir()
    (tmp_path / "drivers/nap.py").write_text(NAP)
    survives_killed_drivers(tmp_path / "drivers", 100, kills=3)


def test_workers_that_die_at_once_end_the_sweep(napping, tmp_path):
    cells = prepared(tmp_path / "out", 3)
    with pytest.raises(ChildProcessError, match=r"1\d workers died, and no cell got done: .* the code 3"):
        supervise(tmp_path / "out", cells, 2, lambda *_: None, lambda _: Process(["/bin/sh", "-c", "exit 3"]))


def test_a_cell_that_fails_is_said_and_one_that_kills_its_workers_is_given_up(napping, tmp_path):
    out = tmp_path / "out"
    cells = prepared(out, 1, "--deadly")
    started = []

    def start(folder):
        started.append(napping(folder))
        return started[-1]

    supervise(out, cells, 1, lambda done, failed: None, start)
    assert len(started) == MOST_BEGUN + 1
    failed = json.loads((out / FOLDER / cells[0].name / FAILED).read_text())
    assert failed["error"] == f"its worker died {MOST_BEGUN} times"
    spec = tmp_path / "spec.yaml"
    spec.write_text("command: doojax nap {who} --out {out}\ngrid: {who: [good, bad]}\n")
    (tmp_path / "two").mkdir()
    with pytest.raises(ValueError, match=r"1 of 2 cells failed, such as .*: ValueError: a bad name"):
        command_in_this_process(spec, tmp_path / "two")
    assert (
        "Traceback" in next((tmp_path / "two" / FOLDER).glob(f"*/{FAILED}")).with_name("log.txt").read_text()
    )


def command_in_this_process(spec: Path, out: Path) -> None:
    """`doojax sweep` whose only worker is this process."""
    cells = cells_of(read_spec(spec))
    (out / CELLS).write_text(json.dumps({c.name: c.command(out / FOLDER / c.name) for c in cells}))
    work(out)
    kept = (out / FOLDER / cell.name / FAILED for cell in cells)
    saved = {path: path.read_text() for path in kept if path.exists()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "doojax.experiments.sweeps.command.supervise",
            lambda *_: [p.write_text(t) for p, t in saved.items()],
        )
        sweep(spec, out=out, workers=1)


def test_cells_are_all_fillings_and_keep_their_names_when_there_are_more():
    few = cells_of(Spec("doojax scenes {task} --seed {seed} --out {out}", {"task": ["toy"]}, seeds=2))
    more = cells_of(Spec("doojax scenes {task} --seed {seed} --out {out}", {"task": ["toy", "x"]}, seeds=3))
    assert len(few) == 2 and len(more) == 6
    assert {cell.name for cell in few} < {cell.name for cell in more}
    assert few[0].command(Path("/a")) == "doojax scenes toy --seed 0 --out /a/out"
    drawn = cells_of(
        Spec("doojax plan toy --planning.goal-bias {bias}", random={"bias": [0.1, 0.4]}, draws=5)
    )
    values = [cell.values["bias"] for cell in drawn]
    assert len(set(values)) == 5 and all(0.1 <= value <= 0.4 for value in values)
    assert values[:3] == [
        cell.values["bias"]
        for cell in cells_of(
            Spec("doojax plan toy --planning.goal-bias {bias}", random={"bias": [0.1, 0.4]}, draws=3)
        )
    ]


def test_a_cells_name_depends_on_the_files_that_it_reads(tmp_path):
    spec = Spec(f"doojax evaluate toy --methods oracle --scenes {tmp_path}/a.scenes --out {{out}}")
    (tmp_path / "a.scenes").write_text("one")
    (first,) = cells_of(spec)
    (tmp_path / "a.scenes").write_text("two")
    (second,) = cells_of(spec)
    assert first.name != second.name and first.line == second.line


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Spec("doojax scenes {task}"), r"holes \['task'\], and there are values for \[\]"),
        (Spec("doojax scenes toy", {"task": ["toy"]}), r"values for \['task'\]"),
        (Spec("doojax scnes toy"), "names no command"),
        (Spec("doojax scenes toy --cuont 2"), "cuont"),
        (Spec("doojax plan toy --seed {s}", random={"s": [2.0, 1.0]}), "expected the least and the greatest"),
        (Spec("doojax scenes {task}", {"task": []}), "values for each name"),
    ],
)
def test_a_spec_that_makes_no_sense_is_refused_before_anything_runs(spec, message):
    with pytest.raises(ValueError, match=message):
        cells_of(spec)


def test_a_file_that_is_no_spec_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no spec"):
        read_spec(tmp_path / "none.yaml")
    (tmp_path / "spec.yaml").write_text("command: 3\n")
    with pytest.raises(ValueError, match="is not the spec of a sweep"):
        read_spec(tmp_path / "spec.yaml")
    (tmp_path / "spec.yaml").write_text("command: [")
    with pytest.raises(ValueError, match="is not the spec of a sweep"):
        read_spec(tmp_path / "spec.yaml")


def test_a_worker_is_this_pythons(tmp_path):
    (tmp_path / CELLS).write_text("{}")
    worker = start_process(tmp_path)
    assert worker.wait(60) == 0


def test_figures_are_told_in_a_terminal_of_80_columns(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    tags = {"task": "rope_dragging", "method": "classifier_augmented", "dynamics": "full_dynamics"}
    about = {"cell": "c", "metric": "conformal_violation_rate_of_all", "delta": 0.05, **tags}
    _show([{**about, "seed": seed, "value": 0.1 + seed} for seed in (0, 1)])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    at = lines.index(["conformal_violation_rate_of_all", "0.6", "2"])
    told = " ".join(word for line in lines[at + 1 :] for word in line)
    assert told == ", ".join(f"{name} {value}" for name, value in {"delta": 0.05, **tags}.items())


@pytest.mark.slow
def test_the_page_of_sweeps_is_right_as_it_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[3] / "docs/sweeps.md").read_text()
    spec = page.split("```yaml\n")[1].split("```")[0]
    Path("spec.yaml").write_text(spec)
    assert (methods := read_spec(Path("spec.yaml")).grid["method"]) and "seeds: 5" in spec
    Path("spec.yaml").write_text(spec.replace("seeds: 5", "seeds: 1"))
    first, second = (line for _, line in list(commands_of(page.splitlines()))[:2])
    assert (first.split()[1], second.split()[1]) == ("scenes", "sweep")
    for function, arguments in [*parsed(first), *parsed(second)]:
        call(function, arguments)
    lines = list(csv.DictReader(Path("sweep/sweep.csv").read_text().splitlines()))
    rates = [line for line in lines if line["metric"] == "success_rate"]
    assert sorted(line["method"] for line in rates) == sorted(methods)
    assert all(line["n"] == "5" for line in rates)
    assert Path("sweep/sweep.png").stat().st_size > 1000
