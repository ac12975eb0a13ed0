"""What there is to show at a path."""

import itertools
import os
from pathlib import Path

from doojax.datasets.files import MANIFEST
from doojax.experiments.trials.outcomes import CONFIG as EVALUATION
from doojax.experiments.trials.outcomes import METHOD
from doojax.files import describe_contents
from doojax.learning.runs import CONFIG, METRICS
from doojax.reading import read_header

ROBOTS = (".xml", ".urdf")  # endings of what is a robot, if it is asked for by its own name
MOST_ITEMS = 2000  # in the page's list
EXPECTATION = (
    f"expected a folder with {MANIFEST} (a data set), a training run, an evaluation, a record (.npz), a "
    "folder of them, or a robot (.xml, .urdf)"
)


def find_items(path: Path) -> list[Path]:
    """The data sets, runs and records at a path: itself, or what lies below it, links to elsewhere left out.

    A robot is one where it is the path itself: other files end as theirs do.

    Raises:
        FileNotFoundError: where there is nothing.
        ValueError: where there is nothing that can be shown, saying what is there.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is nothing at {path}")
    if is_robot(path):
        return [path]
    if path.is_file() and path.suffix != ".npz":
        raise ValueError(f"{path} cannot be shown: {EXPECTATION}")
    if can_be_shown(path):
        return [path]
    root = path.resolve()
    found: list[Path] = []
    folders = [path]
    while folders and len(found) < MOST_ITEMS:
        for item in sorted(folders.pop(0).iterdir()):
            if item.name.startswith(".") or not item.resolve().is_relative_to(root):
                continue
            if can_be_shown(item):
                found.append(item)
            elif item.is_dir() and not item.is_symlink():
                folders.append(item)
    if not found:
        raise ValueError(
            f"{path} holds nothing that can be shown, but {describe_contents(path)}: {EXPECTATION}"
        )
    return found


def changes_in(path: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, times and sizes of what lies at a path and two levels below: another when any of it changes."""
    levels = [path], path.glob("*"), path.glob("*/*")
    files = itertools.islice(itertools.chain(*levels), MOST_ITEMS)
    found = [(str(file), file.lstat()) for file in files if file.exists()]
    return tuple(sorted((name, about.st_mtime_ns, about.st_size) for name, about in found))


def can_be_shown(path: Path) -> bool:
    """Is this a data set, a run or a file that may be a record?"""
    if path.is_file():
        return path.suffix == ".npz"
    return is_dataset(path) or is_run(path) or is_evaluation(path)


def is_dataset(path: Path) -> bool:
    """Is this the folder of a data set?"""
    return (path / MANIFEST).exists()


def is_run(path: Path) -> bool:
    """Is this the folder of a training run?"""
    return (path / CONFIG).exists() and (path / METRICS).exists()


def is_robot(path: Path) -> bool:
    """Is this the file of a robot?"""
    return path.is_file() and path.suffix in ROBOTS


def is_evaluation(path: Path) -> bool:
    """Is this the folder of an evaluation, with at least one method's?"""
    return (path / EVALUATION).is_file() and next(path.glob(f"*/{METHOD}"), None) is not None


def kind_of(path: Path) -> str:
    """A few words on what can be shown, read from no more than a file's head."""
    if path.is_dir():
        return "data set" if is_dataset(path) else "training run" if is_run(path) else "trials"
    try:
        header = read_header(path, "a record")
        if header["format"] == "doojax trial":
            ends = [event["text"] for event in header["events"] if event["kind"] == "end"]
            return str(ends[-1]) if ends else "no end"
        return str(header["format"]).removeprefix("doojax ")
    except (ValueError, KeyError, TypeError, OSError):
        return "cannot be read"


def require_inside(folder: Path, root: Path) -> None:
    """Raise ValueError where something in a folder is a link that leads out of ``root``."""
    root = root.resolve()
    folders = [folder] if folder.is_dir() else []
    while folders:  # not Path.rglob, which takes half a second for ten thousand files
        with os.scandir(folders.pop()) as entries:
            for item in entries:
                if item.is_symlink():
                    if not Path(item.path).resolve().is_relative_to(root):
                        raise ValueError(f"{item.path} leads out of {root}: it is not shown")
                elif item.is_dir():
                    folders.append(Path(item.path))
