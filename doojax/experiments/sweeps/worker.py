"""A worker of a sweep: does one cell after another that nobody else has done or is at.

``python -m doojax.experiments.sweeps.worker FOLDER``. Workers share nothing but the sweep's folder, so they
may run anywhere that sees it. A cell is done when its done.json is there, which appears whole; one whose
worker was killed is begun again by another, and its command goes on where it was.
"""

import contextlib
import fcntl
import json
import os
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

from doojax.commands import call, parsed
from doojax.files import write_whole

CELLS, FOLDER = "cells.json", "cells"
DONE, FAILED, BEGUN, LOG, LOCK = "done.json", "failed.json", "begun", "log.txt", "lock"
PAUSE = 0.5  # s, where all that is left is others'
MOST_BEGUN = 4  # times that a cell is begun in one run of a sweep, before it counts as failed


def work(out: Path) -> int:
    """Work until every cell is over, and return how many this worker has done."""
    lines = {out / FOLDER / name: line for name, line in json.loads((out / CELLS).read_text()).items()}
    count = 0
    while left := [folder for folder in lines if not is_over(folder)]:
        before = count
        for folder in left:
            with contextlib.suppress(BlockingIOError):  # another worker is at it, and may die
                count += _attend(folder, lines[folder])
        if count == before:
            time.sleep(PAUSE)
    return count


def work_from(where: Path, out: Path) -> int:
    """`work`, with the folder ``where`` as the one that relative names begin at."""
    os.chdir(where)
    return work(out)


def is_over(folder: Path) -> bool:
    """Is a cell done, or has it failed?"""
    return (folder / DONE).exists() or (folder / FAILED).exists()


def _attend(folder: Path, line: str) -> bool:
    """Do a cell unless it is over. Raises BlockingIOError where another worker is at it."""
    if is_over(folder):
        return False
    with _locked(folder):
        if is_over(folder):
            return False
        begun = folder / BEGUN
        with begun.open("a") as file:
            file.write("+")
        if begun.stat().st_size > MOST_BEGUN:
            write_whole(folder / FAILED, json.dumps({"error": f"its worker died {MOST_BEGUN} times"}))
            return False
        began = time.perf_counter()
        with (folder / LOG).open("a", encoding="utf-8") as log:
            try:
                with contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
                    for function, arguments in parsed(line):
                        call(function, arguments)
            except (Exception, SystemExit) as error:
                log.write(traceback.format_exc())
                write_whole(folder / FAILED, json.dumps({"error": f"{type(error).__name__}: {error}"}))
                return False
        seconds = round(time.perf_counter() - began, 3)
        write_whole(folder / DONE, json.dumps({"command": line, "seconds": seconds}))
        return True


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Have a cell to oneself, as long as this process lives.

    The lock is a file's, not the folder's: NFS keeps these from machine to machine. Where a file system has
    no locks, nobody is refused.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:  # no locks here
            pass
        yield


def require_locks(out: Path) -> None:
    """Raise OSError where the file system of a sweep's folder has no locks that other machines heed."""
    with (out / LOCK).open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            text = f"{out} is on a file system without locks, so that two machines might do one cell at once"
            raise OSError(error.errno, f"{text}: choose a folder on another one") from error


if __name__ == "__main__":
    work(Path(sys.argv[1]))
