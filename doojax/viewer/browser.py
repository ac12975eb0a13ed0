"""A browser without a window, to look at the page by program: for tests, measurements and screenshots."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAMES = ("chromium", "chromium-browser", "google-chrome")
MISSING = f"""none of {", ".join(NAMES)} is on the PATH. To get one:
  Debian, Ubuntu   sudo apt install chromium libegl1 libgl1-mesa-dri
  Fedora           sudo dnf install chromium"""
QUIET = ("quic", "background-networking", "component-update", "sync", "dev-shm-usage")
OPTIONS = [f"--disable-{what}" for what in QUIET] + ["--no-sandbox", "--no-first-run"]
# Mesa's software renderer is twice as fast as Chromium's own, which stands in where Mesa is missing.
OPTIONS += ["--use-gl=angle", "--use-angle=gl-egl", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]

# viser's note that software draws the page would hide a part of it.
WITHOUT_NOTES = """addEventListener("DOMContentLoaded", () => document.head.insertAdjacentHTML(
  "beforeend", "<style>.mantine-Notifications-root { display: none }</style>"));"""


@contextmanager
def open_browser() -> "Iterator[Browser]":
    """A headless Chromium, driven by Playwright.

    Raises:
        FileNotFoundError: there is none on this machine; the message says how to get it.
        ModuleNotFoundError: Playwright is not installed: `pip install playwright`.
    """
    found = [path for name in NAMES if (path := shutil.which(name))]
    if not found:
        raise FileNotFoundError(MISSING)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found[0], args=OPTIONS)
        try:
            yield browser
        finally:
            browser.close()


def open_page(
    browser: "Browser", port: int, *, width: int = 1280, height: int = 800, script: str = ""
) -> "Page":
    """A page of this machine's `doojax view`, once its controls are there.

    Args:
        browser: where to.
        port: of the server.
        width: of the page, pixels.
        height: of the page, pixels.
        script: run in the page before anything of its own.

    Raises playwright's TimeoutError where that takes longer than a minute.
    """
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(60_000)
    page.add_init_script(WITHOUT_NOTES + script)
    page.goto(f"http://127.0.0.1:{port}/?fixedDpr=1")  # however slow, drawn at full resolution
    page.get_by_text("Read again").wait_for()
    return page
