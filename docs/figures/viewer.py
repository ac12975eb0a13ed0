"""Takes the pictures in results/viewer: python docs/figures/viewer.py DATA PREDICTION TRIAL EVALUATION RUNS

DATA: a data set, as doojax collect writes. PREDICTION: of doojax predict. TRIAL: a record of doojax plan.
EVALUATION: of doojax evaluate. RUNS: a folder of runs of doojax train. What cannot be shown is made up.
"""

import sys
import tempfile
from pathlib import Path

from doojax.robots.robot import DUAL_ARM
from doojax.viewer.app import App
from doojax.viewer.browser import open_browser, open_page
from doojax.viewer.page import start_server

OUT = Path("results/viewer")
WAIT = 2500  # ms until software has drawn all
LONG = 120_000  # ms until a page has its content
SIZES = {"": (1280, 800), "_small": (390, 844)}


def main(data: Path, prediction: Path, trial: Path, evaluation: Path, runs: Path) -> None:
    """Two pictures a kind of content, of a usual and of a small screen."""
    OUT.mkdir(parents=True, exist_ok=True)
    server = start_server("127.0.0.1", 0)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as temporary, open_browser() as browser:
        broken = Path(temporary).relative_to(Path.cwd()) / "photographs"
        broken.mkdir()
        (broken / "rope.jpg").write_bytes(b"")
        robot = broken.with_name(DUAL_ARM.name)
        robot.write_bytes(DUAL_ARM.read_bytes())
        app = App(server, data)
        pages = {
            name: open_page(browser, server.get_port(), width=width, height=height)
            for name, (width, height) in SIZES.items()
        }
        for name, path, keys, tab in (
            ("data", data, "LLLLLLLL", ""),
            ("prediction", prediction, "N", ""),
            ("search", trial, "", "Search"),
            ("trial", trial, "NN", ""),
            ("through", trial, "N", "View"),
            ("trials", evaluation, "", ""),
            ("failed", evaluation, "NNN", ""),
            ("robot", robot, "", ""),
            ("training", runs, "", ""),
            ("message", broken, "", ""),
        ):
            app.close()
            app = App(server, path)
            for page in pages.values():
                page.get_by_text(path.name).first.wait_for(timeout=LONG)
            pages[""].wait_for_timeout(WAIT)
            if name == "failed":
                app.go(next(iter(server.get_clients().values())), first_failed(app))
            for key in keys:
                pages[""].keyboard.press(key)
                pages[""].wait_for_timeout(100)
            for page in pages.values():
                if tab and (found := page.get_by_role("tab", name=tab)).count():
                    found.click()
            pages[""].wait_for_timeout(WAIT)
            for size, page in pages.items():
                page.screenshot(path=OUT / f"{name}{size}.png")
        app.close()
    server.stop()


def first_failed(app: App) -> dict[str, str]:
    """Where the address of the first failed trial leads."""
    row = next(row for row in app._content._rows if not row.line.reached)
    return {"method": row.method, "scene": str(row.line.trial)}


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:6]))
