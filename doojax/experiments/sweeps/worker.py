"""A worker of a sweep: does one cell after another that nobody else has done or is at.

``python -m doojax.experiments.sweeps.worker FOLDER``. Workers share nothing but the sweep's folder, so they
may run anywhere that sees it. A cell is done when its done.json is there, which appears whole; one whose
worker was killed is begun again by another, and its command goes on where it was.
"""

import contextlib
import json
import sys
import time
import traceback
from pathlib import Path

from doojax.commands import call, parsed
from doojax.files import alone_in, write_whole

CELLS, FOLDER = "cells.json", "cells"
DONE, FAILED, BEGUN, LOG = "done.json", "failed.json", "begun", "log.txt"
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


def is_over(folder: Path) -> bool:
    """Is a cell done, or has it failed?"""
    return (folder / DONE).exists() or (folder / FAILED).exists()


def _attend(folder: Path, line: str) -> bool:
    """Do a cell unless it is over. Raises BlockingIOError where another worker is at it."""
    if is_over(folder):
        return False
    with alone_in(folder):
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


if __name__ == "__main__":
    work(Path(sys.argv[1]))
