"""Executors: where workers run; what is lost when a ray node or a job is killed is done elsewhere."""

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from doojax.experiments.sweeps import executors
from doojax.experiments.sweeps.command import rows_of, supervise, sweep
from doojax.experiments.sweeps.executors import executor
from doojax.experiments.sweeps.spec import Cell, Spec, cells_of
from doojax.experiments.sweeps.worker import CELLS, DONE, FOLDER, require_locks

from .naps import NAP

# What workers on other machines import: doojax with one more command.
FAR = """
import doojax.commands
from doojax.experiments.sweeps.worker import work_from
doojax.commands.COMMANDS = {"nap": ("nap:nap", "sleep")}
def work(where, out):
    return work_from(where, out)
"""


@pytest.fixture
def far(tmp_path, monkeypatch):
    """Workers of any executor know the command nap."""
    (tmp_path / "nap.py").write_text(NAP)
    (tmp_path / "far.py").write_text(FAR)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("doojax.commands.COMMANDS", {"nap": ("nap:nap", "sleep")})
    far = importlib.import_module("far")

    monkeypatch.setattr(executors, "work_from", far.work)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "out"


def prepared(out: Path, count: int, seconds: float) -> list[Cell]:
    spec = Spec(f"doojax nap {{who}} --out {{out}} --seconds {seconds}", {"who": [*range(count)]})
    cells = cells_of(spec)
    out.mkdir()
    (out / CELLS).write_text(json.dumps({c.name: c.command(out / FOLDER / c.name) for c in cells}))
    return cells


def pids(out: Path) -> list[list[int]]:
    """Of the processes that began each cell."""
    return [[int(line) for line in file.read_text().split()] for file in out.glob(f"{FOLDER}/*/out/who")]


def done(out: Path) -> int:
    return len(list(out.glob(f"{FOLDER}/*/{DONE}")))


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"doojax\[ray\]"), executor("ray", tmp_path):
        pass
    with pytest.raises(ModuleNotFoundError, match=r"doojax\[slurm\]"), executor("submitit", tmp_path):
        pass
    with executor("local", tmp_path) as (start, most):
        assert start is executors.start_process and most >= 1


def test_a_folder_without_locks_is_refused_where_other_machines_work(tmp_path, monkeypatch):
    require_locks(tmp_path)

    def none(file, how):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr("fcntl.flock", none)
    with pytest.raises(OSError, match="without locks, so that two machines might do one cell at once"):
        require_locks(tmp_path)


def test_slurm_is_asked_now_and_then_and_a_job_is_over_when_its_queue_lacks_it(monkeypatch):
    clock, answers = [100.0], []

    def run(command, **_):
        assert command[0] == "squeue"
        return answers.pop(0)

    monkeypatch.setattr("subprocess.run", run)
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    queue = executors.Queue()
    busy, both, one = (
        subprocess.CompletedProcess([], code, out) for code, out in ((1, ""), (0, "7\n8\n"), (0, "8\n"))
    )
    answers += [busy, both, one]
    assert queue.holds("7", submitted=99.0)  # SLURM was too busy to answer
    clock[0] += 1
    assert queue.holds("7", submitted=99.0) and len(answers) == 2  # not asked so soon again
    clock[0] += executors.ASK_EVERY
    assert queue.holds("7", submitted=99.0) and len(answers) == 1
    assert not queue.holds("6", submitted=99.0) and queue.holds("9", submitted=clock[0] + 0.1)
    clock[0] += executors.ASK_EVERY + 1
    assert not queue.holds("7", submitted=99.0) and queue.holds("8", submitted=99.0)


@pytest.mark.slow
def test_a_killed_node_of_ray_loses_nothing(far):
    ray = pytest.importorskip("ray", reason="pip install 'doojax[ray]'")
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    cells = prepared(far, 40, 0.3)
    cluster = cluster_utils.Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    lost = cluster.add_node(num_cpus=1)
    killed = []

    def report(done: int, failed: int) -> None:
        if len({pid for who in pids(far) for pid in who}) == 2 and done >= 5 and not killed:
            killed.append(done)
            cluster.remove_node(lost, allow_graceful=False)
            cluster.add_node(num_cpus=1)

    try:
        ray.init(address=cluster.address, log_to_driver=False, logging_level="error")
        with executor("ray", far) as (start, most):
            assert most == 2
            supervise(far, cells, most, report, start)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert killed and killed[0] < 35
    assert done(far) == len(rows_of(far, cells)) == len(cells)
    begun = pids(far)
    assert sum(map(len, begun)) <= len(cells) + 1  # but for the one that the node was at, each once
    assert len({pid for who in begun for pid in who}) >= 3  # on the head, the lost and the new node


DRIVE = """
import sys
from pathlib import Path
import far
from doojax.experiments.sweeps import command, executors
executors.work_from = far.work
command.sweep(Path("spec.yaml"), out=Path("out"), executor="ray")
"""


@pytest.mark.slow
def test_a_killed_driver_of_ray_goes_on_where_it_was(far, monkeypatch):
    pytest.importorskip("ray", reason="pip install 'doojax[ray]'")
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    Path("spec.yaml").write_text(
        f"command: doojax nap {{who}} --out {{out}} --seconds 0.3\ngrid: {{who: {[*range(24)]}}}\n"
    )
    cluster = cluster_utils.Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False}
    )
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    try:
        driver = subprocess.Popen([sys.executable, "-c", DRIVE])
        deadline = time.monotonic() + 120
        while done(far) < 4 and time.monotonic() < deadline:
            time.sleep(0.05)
        driver.kill()
        driver.wait()
        before = done(far)
        subprocess.run([sys.executable, "-c", DRIVE], check=True, timeout=300)
    finally:
        cluster.shutdown()
    assert 4 <= before < 24 == done(far)
    assert sum(map(len, pids(far))) <= 24 + 2  # but for those that two workers were at, each once
    assert len((far / "sweep.csv").read_text().splitlines()) == 25


@pytest.mark.slow
def test_the_command_starts_a_ray_of_its_own_where_there_is_none(far):
    ray = pytest.importorskip("ray", reason="pip install 'doojax[ray]'")
    spec = far.parent / "spec.yaml"
    spec.write_text("command: doojax nap {who} --out {out} --seconds 0.2\ngrid: {who: [0, 1, 2, 3, 4, 5]}\n")
    sweep(spec, out=far, executor="ray", workers=1)
    assert not ray.is_initialized()
    assert [len(who) for who in pids(far)] == [1] * 6
    assert len((far / "sweep.csv").read_text().splitlines()) == 7
    assert os.getpid() not in {pid for who in pids(far) for pid in who}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # it leaves processes unwaited
def test_a_killed_job_of_submitit_loses_nothing(far, monkeypatch):
    pytest.importorskip("submitit", reason="pip install 'doojax[slurm]'")
    monkeypatch.setattr("shutil.which", lambda _: None)  # no SLURM: its processes might be of other machines
    cells, killed, started = prepared(far, 30, 0.5), [], []

    def report(done: int, failed: int) -> None:
        if done >= 4 and not killed:
            killed.append(pids(far)[0][0])
            os.kill(killed[0], signal.SIGKILL)

    with executor("submitit", far) as (start, _):
        supervise(far, cells, 2, report, lambda folder: started.append(start(folder)) or started[-1])
    assert killed and done(far) == len(rows_of(far, cells)) == len(cells)
    begun = pids(far)
    assert sum(map(len, begun)) <= len(cells) + 1
    assert len(started) == 3  # two, and one in the place of the killed
    assert list((far / executors.JOBS).glob("*.pkl"))
