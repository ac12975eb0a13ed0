"""Takes the pictures in results/viewer: python docs/figures/viewer.py DATA TRIAL RUN

DATA: a data set, as doojax collect writes. TRIAL: a record of doojax plan. RUN: of doojax train. What a model
predicts is made up, and so is the folder that cannot be shown.
"""

import sys
import tempfile
from pathlib import Path

from doojax.experiments.trials.record_files import save_record
from doojax.viewer.app import App
from doojax.viewer.browser import open_browser, open_page
from doojax.viewer.examples import prediction_record
from doojax.viewer.page import start_server

OUT = Path("results/viewer")
WAIT = 2500  # ms until software has drawn all


def main(data: Path, trial: Path, run: Path) -> None:
    """One picture a kind of content, 1280 x 800 pixels."""
    OUT.mkdir(parents=True, exist_ok=True)
    server = start_server("127.0.0.1", 0)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as temporary, open_browser() as browser:
        folder = Path(temporary).relative_to(Path.cwd())
        predicted, broken = folder / "prediction.npz", folder / "photographs"
        save_record(predicted, prediction_record(seed=3))
        broken.mkdir()
        (broken / "rope.jpg").write_bytes(b"")
        app = App(server, data)
        page = open_page(browser, server.get_port())
        for name, path, moment in (
            ("data", data, 30.0),
            ("prediction", predicted, 9.0),
            ("search", trial, 0.0),
            ("trial", trial, 10.0),
            ("training", run, None),
            ("message", broken, None),
        ):
            app.close()
            app = App(server, path)
            page.wait_for_timeout(WAIT)
            if moment is not None:
                app._content.player.go_to(moment)
                server.flush()
                page.wait_for_timeout(WAIT)
            page.screenshot(path=OUT / f"{name}.png")
        app.close()
    server.stop()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
