"""Tables that are whole in a terminal of 80 columns: what a row is of stands below its name."""

from rich.box import SIMPLE_HEAD
from rich.table import Column, Table
from rich.text import Text


def narrow_table(head: str, *numbers: str, title: str | None = None) -> Table:
    """A table whose first column may be broken, and the others not."""
    columns = (Column(name, no_wrap=True) for name in numbers)
    return Table(head, *columns, title=title, box=SIMPLE_HEAD, pad_edge=False)


def labelled(name: str, more: str) -> Text:
    """A row's name, and below it what it is of, if anything."""
    return Text(name, "bold") + Text(f"\n{more}" if more else "", "dim")
