"""Executors: where workers run; what is lost when a ray node or a job is killed is done elsewhere."""

import importlib
import json
import os
import signal
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
def test_a_killed_job_of_submitit_loses_nothing(far):
    pytest.importorskip("submitit", reason="pip install 'doojax[slurm]'")
    cells, killed = prepared(far, 20, 0.3), []

    def report(done: int, failed: int) -> None:
        if done >= 4 and not killed:
            killed.append(pids(far)[0][0])
            os.kill(killed[0], signal.SIGKILL)

    with executor("submitit", far) as (start, _):
        supervise(far, cells, 2, report, start)
    assert killed and done(far) == len(rows_of(far, cells)) == len(cells)
    begun = pids(far)
    assert sum(map(len, begun)) <= len(cells) + 1
    assert len({pid for who in begun for pid in who}) == 3  # two, and one in the place of the killed
    assert list((far / executors.JOBS).glob("*.pkl"))
