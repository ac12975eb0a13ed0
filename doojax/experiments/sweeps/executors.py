"""Where the workers of a sweep run: on this machine, on a cluster of ray, or as jobs of SLURM.

All of them do the same, `doojax.experiments.sweeps.worker.work`, and share nothing but the sweep's folder,
which every machine has to see. So an executor is no more than a way to start one and to see that it ended.
"""

import getpass
import math
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

from doojax.experiments.sweeps.worker import require_locks, work_from
from doojax.optional import require
from doojax.parts import processors
from doojax.reading import MOST_SAID

ExecutorName = Literal["local", "ray", "submitit"]
WORKER = (sys.executable, "-m", "doojax.experiments.sweeps.worker")
JOBS = "jobs"  # SLURM's scripts and logs, below the sweep's folder
SQUEUE = ("squeue", "-h", "-o", "%A", "-t", "PD,R,S,CF,CG", "-u")  # of whom
ASK_EVERY = 5.0  # s, of SLURM: it has others to serve
MINUTES = 24 * 60  # of a job, where SBATCH_TIMELIMIT says nothing: submitit's own 5 would end most cells


class Worker(Protocol):
    """A worker that was started."""

    def poll(self) -> object:
        """None while it waits or runs; something else when it has ended, however that was."""
        ...

    def terminate(self) -> object:
        """Have it end soon."""
        ...

    def wait(self) -> object:
        """Return when it has ended."""
        ...

    def last_words(self) -> str:
        """Why it ended."""
        ...


Start = Callable[[Path], Worker]  # of a worker in a sweep's folder


@contextmanager
def executor(name: ExecutorName, out: Path) -> Iterator[tuple[Start, int]]:
    """How workers are started, and how many there should be unless a user says otherwise.

    Args:
        name: local, processes on this machine; ray, tasks of the cluster that RAY_ADDRESS names, of one that
            runs on this machine, or else of one that is started here and ended with the sweep; submitit, jobs
            of SLURM, or processes where there is none.
        out: the sweep's folder.

    Raises:
        ModuleNotFoundError: the executor's package is missing; the message names the extra.
        OSError: workers on other machines could not keep out of each other's cells in this folder.
    """
    if name == "local":
        yield start_process, processors()
        return
    require(name)
    require_locks(out)
    if name == "submitit":
        yield _submitit(out), processors()
        return
    import ray  # pyright: ignore[reportMissingImports]

    begun = not ray.is_initialized()
    if begun:
        ray.init(log_to_driver=False, logging_level="error")
    try:
        yield partial(RayWorker, Path.cwd()), max(1, int(ray.cluster_resources().get("CPU", 1)))
    finally:
        if begun:
            ray.shutdown()


class Process(subprocess.Popen):
    """A worker on this machine; what it has to complain about, it says in this terminal."""

    def last_words(self) -> str:
        """How it ended."""
        return f"the last one with the code {self.poll()}"


def start_process(out: Path) -> Process:
    """A worker on this machine; it ends when there is nothing left that it can do."""
    return Process([*WORKER, str(out)], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


class RayWorker:
    """A task of ray, on one processor of whichever machine has one free; ray itself does not try it again."""

    def __init__(self, where: Path, out: Path):
        """Have one started in the folder ``where``, which relative names in commands begin at."""
        import ray  # pyright: ignore[reportMissingImports]

        options: dict[str, Any] = {"num_cpus": 1, "max_retries": 0, "scheduling_strategy": "SPREAD"}
        self._task = ray.remote(work_from).options(**options).remote(where, out)

    def poll(self) -> object:
        """None while it waits or runs; True when it is over or its machine is lost."""
        import ray  # pyright: ignore[reportMissingImports]

        return True if ray.wait([self._task], timeout=0)[0] else None

    def terminate(self) -> None:
        """Have it end at once."""
        import ray  # pyright: ignore[reportMissingImports]

        ray.cancel(self._task, force=True)

    def wait(self) -> None:
        """Return when it has ended."""
        import ray  # pyright: ignore[reportMissingImports]

        ray.wait([self._task])

    def last_words(self) -> str:
        """What ray says of it."""
        import ray  # pyright: ignore[reportMissingImports]

        try:
            return f"the last one did {ray.get(self._task)} cells"
        except Exception as error:  # whatever was raised there
            return str(error).strip().rpartition("\n")[2][:MOST_SAID]


class Job:
    """A job of submitit."""

    def __init__(self, job: Any, queue: "Queue | None"):
        """Of what an executor's submit returned; without a queue it is a process on this machine."""
        self._job, self._queue, self._submitted = job, queue, time.monotonic()

    def poll(self) -> object:
        """None while it waits or runs; True when it is over, failed or was lost."""
        if self._queue is None:
            return True if self._job.done() else None
        return None if self._queue.holds(self._job.job_id, self._submitted) else True

    def terminate(self) -> None:
        """Have it end soon."""
        self._job.cancel()

    def wait(self) -> None:
        """Nothing to wait for: SLURM ends what was cancelled."""

    def last_words(self) -> str:
        """Where it said why."""
        return f"see {self._job.paths.stderr}"


class Queue:
    """This user's jobs that wait or run. Unlike sacct, which submitit asks, squeue needs no accounting."""

    def __init__(self):
        """Nothing has been asked yet."""
        self._jobs: set[str] = set()
        self._asked = self._known = -math.inf  # when; _known: with an answer

    def holds(self, job: str, submitted: float) -> bool:
        """Does a job wait or run, as far as SLURM has said since it was submitted?"""
        if time.monotonic() - self._asked > ASK_EVERY:
            self._asked = time.monotonic()
            answer = subprocess.run([*SQUEUE, getpass.getuser()], capture_output=True, text=True)
            if answer.returncode == 0:  # otherwise it is too busy to say
                self._jobs, self._known = set(answer.stdout.split()), self._asked
        return self._known < submitted or job in self._jobs


def _submitit(out: Path) -> Start:
    import submitit  # pyright: ignore[reportMissingImports]

    slurm = shutil.which("sbatch") is not None
    jobs = submitit.AutoExecutor(folder=out / JOBS, cluster="slurm" if slurm else "local")
    jobs.update_parameters(name="doojax-sweep", timeout_min=MINUTES, cpus_per_task=1, tasks_per_node=1)
    where, queue = Path.cwd(), Queue() if slurm else None
    return lambda folder: Job(jobs.submit(work_from, where, folder), queue)
