"""A command for sweeps to be tested with."""

# A command that is done in an instant, notes who did it, and on demand is the end of its worker.
NAP = """
import os, signal, time
from pathlib import Path
def nap(name: str, /, *, out: Path, seconds: float = 0.05, deadly: bool = False) -> None:
    '''Sleep.'''
    out.mkdir(parents=True, exist_ok=True)
    with (out / "who").open("a") as file:
        file.write(f"{os.getpid()}\\n")
    if deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    if name == "bad":
        raise ValueError("a bad name")
    time.sleep(seconds)
"""
