"""One browser, one server and one set of made-up contents for all tests of the page."""

import io
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page

from doojax.experiments.trials.record_files import save_record
from doojax.viewer.app import App
from doojax.viewer.browser import open_browser, open_page
from doojax.viewer.examples import prediction_record, trial_record, write_dataset
from doojax.viewer.page import FIELD_OF_VIEW, start_server
from doojax.viewer.raycast import Camera

SIZE = {"width": 1000, "height": 640}
View = Callable[[int, int], tuple[np.ndarray, np.ndarray]]
PATIENCE = 40  # s: what is waited for comes within one on an idle machine
TRAJECTORIES = 150


@pytest.fixture(scope="package")
def contents(tmp_path_factory) -> Path:
    """A folder with a data set of three shards, a prediction and a trial."""
    folder = tmp_path_factory.mktemp("contents")
    write_dataset(folder / "towed", TRAJECTORIES)
    save_record(folder / "prediction.npz", prediction_record())
    save_record(folder / "trial.npz", trial_record(seed=2))
    return folder


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    with open_browser() as found:
        yield found


@pytest.fixture(scope="package")
def server():
    server = start_server("127.0.0.1", 0)
    yield server
    server.stop()


class Look:
    """A page as somebody sees it."""

    def __init__(self, page: Page):
        self.page = page

    def labelled(self, label: str):
        """The input, or inputs, beside a label."""
        row = self.page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]")
        return row.locator("input")

    def enter(self, label: str, value: object) -> None:
        """Type into the number beside a label."""
        box = self.labelled(label).last
        box.fill(str(value))
        box.press("Enter")
        box.blur()

    def choose(self, label: str, option: str) -> None:
        """Choose from the list beside a label."""
        self.labelled(label).first.click()
        self.page.get_by_role("option", name=option).first.click()

    def tab(self, name: str) -> None:
        """Open a tab."""
        self.page.get_by_role("tab", name=name).click()

    def slide(self, label: str, part: float) -> None:
        """Click on the slider beside a label, at a part of its length."""
        row = self.page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]")
        track = row.locator(".mantine-Slider-track").bounding_box()
        self.page.mouse.click(track["x"] + part * track["width"], track["y"] + track["height"] / 2)

    def number(self, label: str) -> int:
        """The whole number beside a label."""
        return int(self.labelled(label).last.input_value())

    def wait_for(self, text: str | re.Pattern[str], seconds: float = PATIENCE) -> None:
        """Wait until a text is seen."""
        self.page.get_by_text(text).first.wait_for(timeout=1000 * seconds)

    def press(self, *keys: str) -> None:
        """Press keys, one after another, on nothing in particular."""
        self.page.evaluate("document.activeElement.blur()")
        for key in keys:
            self.page.keyboard.press(key)

    def until(self, holds: Callable[[], bool], seconds: float = PATIENCE) -> None:
        """Wait until something holds."""
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end, "it never came to hold"
            self.page.wait_for_timeout(50)

    def pixels(self) -> np.ndarray:
        """The picture of the scene [h, w, 3]."""
        picture = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
        canvas = self.page.locator("canvas").evaluate_all(
            "all => all.map(c => c.getBoundingClientRect()).sort((a, b) => b.width * b.height - "
            "a.width * a.height).map(r => [r.x, r.y, r.width, r.height])[0]"
        )
        left, top, width, height = (round(value) for value in canvas)
        return np.asarray(picture)[top : top + height, left : left + width].astype(int)

    def colour_at(self, view: View, place: np.ndarray) -> np.ndarray:
        """The colour seen at a place in the world by a camera that is where `doojax.viewer.page` puts it."""
        pixels = self.pixels()
        height, width = pixels.shape[:2]
        column, row = self.projected(view(width, height), width, height, place)
        return pixels[round(float(row)), round(float(column))]

    @staticmethod
    def projected(at: tuple[np.ndarray, np.ndarray], width: int, height: int, places: np.ndarray):
        """Columns and rows of places in the world, by a camera's own place and target."""
        looking = Camera.looking(*at, np.array([0.0, 0.0, 1.0]), width, height, None)
        exact = Camera(looking.eye, looking.axes, width, height, None, float(np.tan(FIELD_OF_VIEW / 2)))
        return exact.project(np.asarray(places, np.float32))[:2]

    def ticks(self) -> list[tuple[list[float], list[str]]]:
        """Where the numbers at the upright axes of all plots stand, and how they are written."""
        return self.page.evaluate(
            "Object.values(window.__viserTestpoints.uplots ?? {}).map(plot => "
            "[plot.chart.axes[1]._splits, plot.chart.axes[1]._values])"
        )


@pytest.fixture(scope="package")
def new_look(browser, server) -> Iterator[Callable[..., Look]]:
    """Opens another page on the server."""
    pages = []

    def make(**size: int) -> Look:
        page = open_page(browser, server.get_port(), **SIZE | size)
        pages.append(page)
        return Look(page)

    yield make
    for page in pages:
        page.close()


@pytest.fixture(scope="package")
def opened(server) -> Iterator[list[App]]:
    """What the server shows, in a list of at most one."""
    shown: list[App] = []
    yield shown
    for app in shown:
        app.close()


@pytest.fixture(scope="package")
def first_look(new_look, opened, server, contents) -> Look:
    """The page that most tests look at: opened once, and shown one thing after another."""
    opened.append(App(server, contents / "towed"))
    return new_look()


@pytest.fixture
def view(first_look, opened, server) -> Callable[[Path], tuple[Look, App]]:
    """Shows what is at a path, in the page that is open."""

    def show(path: Path) -> tuple[Look, App]:
        again = first_look.page.get_by_text("Read again")
        while opened:
            before = opened.pop()
            before.close()
            before._page.clear()
            server.flush()
            again.wait_for(state="hidden")
        opened.append(App(server, path))
        again.wait_for()
        return first_look, opened[0]

    return show
