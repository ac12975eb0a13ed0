"""`doojax view`: a page on data sets, training runs, predictions, trials and robots."""

import ipaddress
import os
import socket
import threading
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import tyro
import viser
from rich.console import Console

from doojax.datasets import Dataset
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.records import TrialRecord
from doojax.learning.runs import RunDirectory
from doojax.robots import DUAL_ARM, read_robot
from doojax.viewer.addresses import EYE, TARGET, read_place
from doojax.viewer.dataset_page import DatasetPage
from doojax.viewer.evaluation_page import EvaluationPage
from doojax.viewer.listing import (
    changes_in,
    find_items,
    is_dataset,
    is_evaluation,
    is_robot,
    is_run,
    kind_of,
    require_inside,
)
from doojax.viewer.page import Page, Server, start_server
from doojax.viewer.prediction_page import PredictionPage
from doojax.viewer.robot_page import RobotPage
from doojax.viewer.run_page import RunPage
from doojax.viewer.trial_page import TrialPage

LOOK_AGAIN = 2.0  # s
OWN_ROBOT = "dual_arm"  # by this name the robot that comes with doojax is shown


@runtime_checkable
class Content(Protocol):
    """What a page shows."""

    def close(self) -> None:
        """End what runs beside the page."""
        ...

    def go(self, wanted: Mapping[str, str]) -> None:
        """Go to where an address leads; what it does not say stays as it is."""
        ...


def view(
    path: tyro.conf.Positional[Path],
    /,
    *,
    tools: tuple[str, ...] | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> None:
    """Look at data sets, training runs, predictions, trials and robots in a browser, until Ctrl-C.

    Args:
        path: a data set, a run, a record (.npz), or a folder that holds some; or a robot: an MJCF or URDF
            file, or dual_arm, which comes with doojax.
        tools: of a robot, its sites or bodies; by default all sites, or without any what carries nothing.
        host: the address to bind to. By default only this machine can look; 0.0.0.0 lets everybody in reach.
        port: the port to bind to; 0 takes any that is free.

    Raises:
        OSError: where the address or the port cannot be had.
    """
    server = start_server(host, port)
    console = Console(soft_wrap=True)
    App(server, meant_by(path), tools)
    shown = f"[{host}]" if ":" in host else {"0.0.0.0": "localhost"}.get(host, host)
    text = f"{path} is shown at http://{shown}:{server.get_port()} (Ctrl-C ends)"
    console.print(text, highlight=False, markup=False)
    if not is_loopback(host):
        console.print(
            f"Bound to {host}: everybody who can reach this machine can look, no password.",
            style="yellow",
            markup=False,
        )
    if hint := tunnel_hint(host, server.get_port(), os.environ):
        console.print(hint, highlight=False, markup=False)
    try:
        threading.Event().wait()
    finally:
        server.stop()


def meant_by(path: Path) -> Path:
    """The file of the robot that comes with doojax, if its name is given and nothing else has it."""
    return DUAL_ARM if str(path) == OWN_ROBOT and not path.exists() else path


def tunnel_hint(host: str, port: int, environment: Mapping[str, str]) -> str:
    """How to look from the machine that somebody has come from by ssh; "" where nobody has, or need not."""
    if "SSH_CONNECTION" not in environment or not is_loopback(host):
        return ""
    here = environment["SSH_CONNECTION"].split()[2:3] or [socket.gethostname()]
    user = environment.get("USER", "")
    at = f"{user}@{here[0]}" if user else here[0]
    return (
        f"From the machine that you have come from by ssh: ssh -N -L {port}:localhost:{port} {at}, "
        f"then http://localhost:{port} there"
    )


def is_loopback(host: str) -> bool:
    """Does the address belong to this machine alone?"""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def open_content(
    page: Page,
    path: Path,
    root: Path,
    beside: Sequence[Path] = (),
    tools: tuple[str, ...] | None = None,
) -> Content:
    """Show a data set, a run, an evaluation, a record or a robot in a page, nothing from outside of ``root``.

    Args:
        page: where to.
        path: of what is shown.
        root: all that may be shown lies below it.
        beside: what else there is, for what can be compared.
        tools: of a robot, see `doojax.robots.read_robot`.

    Raises ValueError or OSError where it cannot be read.
    """
    require_inside(path, root)
    if is_dataset(path):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the page itself says that a data set is unfinished
            return DatasetPage(page, Dataset.open(path))
    if is_run(path):
        return RunPage(
            page, RunDirectory(path), [other for other in beside if is_run(other) and other != path]
        )
    if is_evaluation(path):
        return EvaluationPage(page, path)
    if is_robot(path):
        return RobotPage(page, read_robot(path, tools), path)
    record = load_record(path)
    if isinstance(record, TrialRecord):
        return TrialPage(page, record, path)
    return PredictionPage(page, record, str(path))


class App:
    """One page on one path: a list of what is there, and whichever of it is chosen."""

    def __init__(self, server: Server, path: Path, tools: tuple[str, ...] | None = None):
        """Show the first thing at ``path``, or say what is wrong with it; ``tools`` are a robot's."""
        self._path, self._tools = path, tools
        self._page = Page(server)
        self._content: Content | None = None
        self._chosen: Path | None = None
        self._names: dict[str, Path] = {}  # what there is, by what it is called
        self._pick: viser.GuiDropdownHandle | None = None
        self._stopped = threading.Event()
        server.on_address = self.go
        self._page.call(self.reload)
        threading.Thread(target=self._watch, name="contents", daemon=True).start()

    def reload(self, chosen: Path | None = None) -> None:
        """Look at the path again and show an item of it, the first by default."""
        page = self._page
        self._end()
        page.clear()
        gui = page.server.gui
        self._pick, self._names = None, {}
        try:
            items = find_items(self._path)
            chosen = chosen if chosen in items else items[0]
            self._chosen = chosen
            self._list(items)
            self._content = open_content(page, chosen, self._path, items, self._tools)
        finally:
            again = gui.add_button("Read again", order=1e9, hint="What is at the path may have changed")
            again.on_click(page.calling(lambda: self.reload(chosen)))

    def _list(self, items: Sequence[Path]) -> None:
        """Offer what there is; what is shown stays."""
        self._page.shown = (
            {"show": self._chosen.relative_to(self._path)} if self._chosen and items[1:] else {}
        )
        if self._chosen is None or len(items) < 2:
            return
        called = {item: name for name, item in self._names.items()}
        self._names = {
            called.get(item) or f"{item.relative_to(self._path)} · {kind_of(item)}": item for item in items
        }
        (shown,) = (name for name, item in self._names.items() if item == self._chosen)
        if self._pick is None:
            self._pick = self._page.server.gui.add_dropdown(
                "Show", tuple(self._names), initial_value=shown, order=-1e9
            )
            self._pick.on_update(self._picked)
        else:
            self._pick.options = tuple(self._names)

    def _picked(self, _: object) -> None:
        wanted = self._names.get(str(self._pick.value)) if self._pick is not None else None
        if wanted is not None and wanted != self._chosen:
            self._page.call(lambda: self.reload(wanted))

    def _watch(self) -> None:
        """Look again and again whether there is more to show, or at last something."""
        before = self._there()
        while not self._stopped.wait(LOOK_AGAIN):
            now = self._there()
            if now != before:
                self._page.call(self._renew, aloud=False)
                now = self._there()  # which is of another kind once something is shown
            before = now

    def _there(self) -> object:
        """What is another when there is more to show, or what could not be shown has changed."""
        try:
            return find_items(self._path) if self._content is not None else changes_in(self._path)
        except (ValueError, OSError) as error:
            return str(error)

    def _renew(self) -> None:
        if self._stopped.is_set():
            return
        if self._content is None:
            self.reload(self._chosen)
            return
        items = find_items(self._path)
        if self._chosen in items:  # what is gone is shown until something else is chosen
            self._list(items)

    def go(self, client: viser.ClientHandle, wanted: dict[str, str]) -> None:
        """Show what an address says, to everybody; its camera is for who has come by it."""

        def show() -> None:
            if "show" in wanted and self._path / wanted["show"] != self._chosen:
                item = self._path / wanted["show"]
                if item not in find_items(self._path):
                    raise ValueError(f"there is no {wanted['show']} in {self._path}")
                self.reload(item)
            if self._content is not None:
                self._content.go(wanted)
            if EYE in wanted and TARGET in wanted:
                self._page.put(client, read_place(wanted[EYE]), read_place(wanted[TARGET]))

        self._page.call(show)

    def close(self) -> None:
        """End what runs beside the page."""
        self._stopped.set()
        self._end()

    def _end(self) -> None:
        if self._content is not None:
            self._content.close()
            self._content = None
