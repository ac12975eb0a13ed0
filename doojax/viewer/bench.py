"""How soon the page opens, how fast it follows a key, how smoothly a large tree turns.

All is seen from inside a headless Chromium on this machine, in a page of 1280 x 800 pixels that software
draws: a graphics card draws the same faster. The contents are made up (`doojax.viewer.examples`).
"""

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from doojax.benchmarks.signature import median_with_interval
from doojax.experiments.records import save_record
from doojax.experiments.reports import Row, row, show, write_summary
from doojax.viewer.app import App
from doojax.viewer.browser import open_browser, open_page
from doojax.viewer.examples import trial_record, write_dataset
from doojax.viewer.page import Page as Viewed
from doojax.viewer.page import Server, start_server

if TYPE_CHECKING:
    from playwright.sync_api import Page

SEED = 2
TRAJECTORIES = 10_000
NODES = 20_000
OPENINGS = 7
CHANGES = 60
SECONDS = 8.0  # for which the tree is turned
SOFTWARE = {"renderer": "software", "page": "1280x800"}

# Keeps what was drawn readable, and notes the frames in which a large tree was drawn.
WATCH = """
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function(kind, options) {
  return getContext.call(this, kind, {...options, preserveDrawingBuffer: true});
};
const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
window.treeFrames = new Set();
WebGL2RenderingContext.prototype.drawElementsInstanced = function(mode, count, type, offset, instances) {
  if (instances > 10000) window.treeFrames.add(document.timeline.currentTime);
  return draw.call(this, mode, count, type, offset, instances);
};
const small = new OffscreenCanvas(640, 400).getContext("2d", {willReadFrequently: true});
window.picture = () => {
  const all = [...document.querySelectorAll("canvas")];
  small.drawImage(all.reduce((a, b) => a.width * a.height > b.width * b.height ? a : b), 0, 0, 640, 400);
  let hash = 0;
  for (const pixel of new Uint32Array(small.getImageData(0, 0, 640, 400).data.buffer))
    hash = (Math.imul(hash, 31) + pixel) | 0;
  return hash;
};
window.nextFrame = () => new Promise(requestAnimationFrame);
window.changed = async before => {
  const start = performance.now();
  while (window.picture() === before) {
    if (performance.now() - start > 20000) throw new Error("the picture stayed the same for 20 s");
    await window.nextFrame();
  }
  return performance.now();
};
window.settled = async () => {
  const start = performance.now();
  for (let last = "", same = 0; same < 6; await window.nextFrame()) {
    if (performance.now() - start > 20000) throw new Error("the picture kept changing for 20 s");
    const now = window.picture();
    same = now === last ? same + 1 : 0;
    last = now;
  }
};
"""
# Presses the key that steps by one state, and waits until the picture is another. Milliseconds.
CHANGE = """async letter => {
  await window.settled();
  const key = {key: letter.toLowerCase(), code: "Key" + letter, bubbles: true};
  const before = window.picture(), start = performance.now();
  document.body.dispatchEvent(new KeyboardEvent("keydown", key));
  document.body.dispatchEvent(new KeyboardEvent("keyup", key));
  return await window.changed(before) - start;
}"""
# Waits for what comes next. Seconds, of the clock that Python reads too.
NEXT = """async () => {
  await window.settled();
  window.next = window.changed(window.picture()).then(end => (performance.timeOrigin + end) / 1000);
}"""


def viewer(*, json: bool = False, out: Path = Path("results/viewer")) -> None:
    """Measure the page of `doojax view` in a headless Chromium; write results/viewer.

    open_s: from the opening of a data set by the server until its first rope is drawn in a page that was
    open before. frame_ms: from the key that steps in time until another picture is drawn in the page.
    tree_fps: frames a second that were drawn while the mouse turned the view of a search tree.

    Args:
        json: print the rows as JSON instead of a table.
        out: the folder of summary.json.

    Raises:
        FileNotFoundError: there is no Chromium; the message says how to get it.
    """
    server = start_server("127.0.0.1", 0)
    try:
        with tempfile.TemporaryDirectory() as temporary, open_browser() as browser:
            folder = Path(temporary)
            write_dataset(folder / "towed", TRAJECTORIES)
            save_record(folder / "trial.npz", trial_record(seed=SEED, nodes=NODES))
            app = App(server, folder / "towed")
            page = open_page(browser, server.get_port(), script=WATCH)
            rows = [changing(page)]
            app.close()
            rows += [opening(server, page, folder / "towed"), turning(server, page, folder / "trial.npz")]
    finally:
        server.stop()
    write_summary(out / "summary.json", command="doojax bench viewer", seed=SEED, rows=rows)
    show(rows, json)


def changing(page: "Page") -> Row:
    """Step to and fro in time, in a page that shows a data set."""
    keys = ["L" if step // 25 % 2 == 0 else "J" for step in range(CHANGES)]
    found = np.array([page.evaluate(CHANGE, key) for key in keys])
    return median_row("frame_ms", {"trajectories": TRAJECTORIES}, found, "ms")


def opening(server: Server, page: "Page", path: Path) -> Row:
    """Open a data set again and again, in a page that shows nothing before."""
    found = []
    for _ in range(OPENINGS):
        Viewed(server).clear()
        page.get_by_text("Read again").wait_for(state="hidden")
        page.evaluate(NEXT)
        start = time.time()
        app = App(server, path)
        end = page.evaluate("window.next")
        page.get_by_text("Read again").wait_for()
        found.append(max(end, time.time()) - start)  # the controls come after the picture, or before it
        app.close()
    return median_row("open_s", {"trajectories": TRAJECTORIES}, np.array(found), "s")


def turning(server: Server, page: "Page", path: Path) -> Row:
    """Turn the view of a search tree with the mouse."""
    app = App(server, path)
    page.get_by_text(f"{NODES:,} nodes").wait_for()
    page.evaluate("async () => { await window.settled(); window.treeFrames.clear(); }")
    page.mouse.move(300, 400)
    page.mouse.down()
    end, step = time.monotonic() + SECONDS, 0
    while time.monotonic() < end:
        step += 1
        page.mouse.move(300 + 4 * step % 300, 400)
    page.mouse.up()
    frames = np.sort(page.evaluate("[...window.treeFrames]"))
    app.close()
    rate = 1000 * (len(frames) - 1) / (frames[-1] - frames[0])
    return row("tree_fps", {"nodes": NODES, **SOFTWARE}, rate, "1/s", n=len(frames))


def median_row(metric: str, tags: dict[str, int], found: np.ndarray, unit: str) -> Row:
    """The median of some measurements."""
    median, low, high = median_with_interval(found)
    return row(metric, {**tags, **SOFTWARE}, median, unit, low, high, len(found))
