"""What a bench is at, for who waits for it."""

import time
from collections.abc import Iterator, Sequence

from rich.console import Console


def stages[T](title: str, items: Sequence[tuple[str, T]]) -> Iterator[T]:
    """The items one after another, each announced on the standard error: its number, and minutes so far."""
    console, begun = Console(stderr=True), time.perf_counter()
    for number, (text, item) in enumerate(items, start=1):
        minutes = (time.perf_counter() - begun) / 60
        console.print(f"{title} {number}/{len(items)}, after {minutes:.1f} min: {text}", highlight=False)
        yield item
