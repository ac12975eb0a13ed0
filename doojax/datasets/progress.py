"""The bar that long work shows."""

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


def announce(text: str) -> None:
    """A word on the standard error before what takes long and shows no bar."""
    Console(stderr=True, markup=False, highlight=False, soft_wrap=True).print(text)


def progress_bar(console: Console) -> Progress:
    """How much is done, a task's field ``note``, the time gone by and the time left."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )
