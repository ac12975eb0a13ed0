"""`doojax view`: a page on anything that doojax writes."""

import ipaddress
import threading
import warnings
from pathlib import Path
from typing import Protocol, runtime_checkable

import tyro
from rich.console import Console

from doojax.datasets import Dataset
from doojax.datasets.files import MANIFEST, describe_contents
from doojax.experiments.records import TrialRecord, load_record
from doojax.viewer.dataset_page import DatasetPage
from doojax.viewer.page import Page, Server, start_server
from doojax.viewer.prediction_page import PredictionPage
from doojax.viewer.trial_page import TrialPage

MOST_ITEMS = 2000  # in the page's list


@runtime_checkable
class Content(Protocol):
    """What a page shows."""

    def close(self) -> None:
        """End what runs beside the page."""
        ...


def view(path: tyro.conf.Positional[Path], /, *, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Look at data sets, predictions and trials in a browser, until Ctrl-C.

    Args:
        path: a data set, a record (.npz), or a folder that holds some.
        host: the address to bind to. By default only this machine can look; 0.0.0.0 lets everybody in reach.
        port: the port to bind to; 0 takes any that is free.

    Raises:
        OSError: where the address or the port cannot be had.
    """
    server = start_server(host, port)
    console = Console(soft_wrap=True)
    App(server, path)
    shown = f"[{host}]" if ":" in host else {"0.0.0.0": "localhost"}.get(host, host)
    console.print(f"{path} is shown at http://{shown}:{server.get_port()} (Ctrl-C ends)", highlight=False)
    if not is_loopback(host):
        console.print(
            f"[yellow]Bound to {host}: everybody who can reach this machine can look, no password.[/]"
        )
    try:
        threading.Event().wait()
    finally:
        server.stop()


def is_loopback(host: str) -> bool:
    """Does the address belong to this machine alone?"""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def find_items(path: Path) -> list[Path]:
    """The data sets and records at a path: itself, or what lies below it, links to elsewhere left out.

    Raises:
        FileNotFoundError: where there is nothing.
        ValueError: where there is nothing that can be shown, saying what is there.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is nothing at {path}")
    if path.is_file() or (path / MANIFEST).exists():
        if path.is_file() and path.suffix != ".npz":
            raise ValueError(f"{path} cannot be shown: {EXPECTATION}")
        return [path]
    root = path.resolve()
    found: list[Path] = []
    folders = [path]
    while folders and len(found) < MOST_ITEMS:
        for item in sorted(folders.pop(0).iterdir()):
            if not item.resolve().is_relative_to(root):
                continue
            if item.suffix == ".npz" or (item / MANIFEST).exists():
                found.append(item)
            elif item.is_dir() and not item.is_symlink():
                folders.append(item)
    if not found:
        raise ValueError(
            f"{path} holds nothing that can be shown, but {describe_contents(path)}: {EXPECTATION}"
        )
    return found


EXPECTATION = f"expected a data set (a folder with {MANIFEST}), records (.npz), or a folder that holds some"


def open_content(page: Page, path: Path) -> Content:
    """Show a data set or a record in a page.

    Raises ValueError or OSError where it cannot be read.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the page itself says that a data set is unfinished
        if path.is_dir():
            return DatasetPage(page, Dataset.open(path))
    record = load_record(path)
    if isinstance(record, TrialRecord):
        return TrialPage(page, record, str(path))
    return PredictionPage(page, record, str(path))


class App:
    """One page on one path: a list of what is there, and whichever of it is chosen."""

    def __init__(self, server: Server, path: Path):
        """Show the first thing at ``path``, or say what is wrong with it."""
        self._path = path
        self._page = Page(server)
        self._content: Content | None = None
        self._page.call(self.reload)

    def reload(self, chosen: str | None = None) -> None:
        """Look at the path again and show an item of it, the first by default."""
        page = self._page
        self.close()
        page.clear()
        gui = page.server.gui
        try:
            items = find_items(self._path)
            names = {str(item.relative_to(self._path)): item for item in items}
            chosen = chosen if chosen in names else next(iter(names))
            if len(names) > 1:
                pick = gui.add_dropdown("Show", tuple(names), initial_value=chosen)
                pick.on_update(page.calling(lambda: self.reload(pick.value)))
            self._content = open_content(page, names[chosen])
        finally:
            again = gui.add_button("Read again", order=1e9, hint="What is at the path may have changed")
            again.on_click(page.calling(lambda: self.reload(chosen)))

    def close(self) -> None:
        """End what runs beside the page."""
        if self._content is not None:
            self._content.close()
            self._content = None
