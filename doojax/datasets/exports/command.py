"""A data set in the layout of another library: `doojax export`."""

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from rich.console import Console

from doojax.datasets.exports.episodes import episodes_of
from doojax.datasets.progress import announce
from doojax.datasets.store import Dataset
from doojax.files import TEMPORARY, alone_in, describe_contents, flush, room_explained
from doojax.optional import require

Layout = Literal["lerobot", "minari"]
MINARI_NAME = re.compile(r"[-_0-9A-Za-z]+-v\d+")
NEEDS = {"lerobot": "pyarrow", "minari": "h5py"}


def export(data: Path, /, *, format: Layout, out: Path) -> None:
    """Write a data set as a folder that LeRobot or Minari reads.

    Each trajectory with values throughout is an episode; those that became unstable are left out. Splits are
    doojax's, and stand side by side: first all episodes of train, then validation, calibration and test.

    Args:
        data: the data set's folder, complete.
        format: lerobot (version 3.0 of its layout: Parquet and JSON) or minari (HDF5 and JSON).
        out: the folder to make, new or empty; for minari named like rope-v0, in Minari's folder of data sets.

    Raises:
        FileNotFoundError: there is no data set.
        ValueError: it is unfinished or has no trajectory with values, or `out` holds something.
        ModuleNotFoundError: the extra export is not installed.
    """
    require(NEEDS[format])
    dataset = Dataset.open(data)
    if format == "minari":
        check_minari_name(out)
    with made_whole(out) as folder:
        announce(f"reading {data}")
        episodes = episodes_of(dataset)
        announce(f"writing {len(episodes)} episodes for {format}")
        if format == "minari":
            from doojax.datasets.exports.minari import write_minari

            write_minari(episodes, folder, out.name)
        else:
            from doojax.datasets.exports.lerobot import write_lerobot

            write_lerobot(episodes, folder)
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    parts = ", ".join(f"{len(part)} {name}" for name, part in episodes.splits.items())
    console.print(f"{len(episodes)} episodes of {episodes.steps} steps in {out}: {parts}")
    if episodes.left_out:
        console.print(f"trajectories without values, left out: {episodes.left_out}", style="yellow")


def check_minari_name(folder: Path) -> None:
    """Raise ValueError unless a folder's name can be that of a Minari data set, such as rope-v0."""
    if not MINARI_NAME.fullmatch(folder.name):
        like = re.sub(r"[^-_0-9A-Za-z]+", "_", folder.name)
        raise ValueError(
            f"{folder.name!r} is no name of a Minari data set, which is that of its folder: letters, digits, "
            f"- and _, and a version at the end, as in {like}-v0"
        )


@contextmanager
def made_whole(out: Path) -> Iterator[Path]:
    """A folder to fill, which takes the place of ``out`` when all of it is on the disk, or vanishes.

    Raises:
        ValueError: ``out`` is a file, or holds something.
        BlockingIOError: another process works in it.
    """
    with alone_in(out), room_explained(out, safe="nothing was written there"):
        if any(out.iterdir()):
            raise ValueError(f"{out} holds {describe_contents(out)}: choose a new or empty folder")
        folder = out.with_name(f".{out.name}{TEMPORARY}")
        shutil.rmtree(folder, ignore_errors=True)  # of one that was killed
        folder.mkdir()
        try:
            yield folder
            for path in [*folder.rglob("*"), folder]:
                flush(path)
            folder.replace(out)
            flush(out.parent)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
