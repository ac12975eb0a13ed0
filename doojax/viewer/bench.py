"""How soon the page opens, how fast it follows a key, how smoothly a large tree turns.

All is seen from inside a headless Chromium on this machine, in a page of 1280 x 800 pixels that software
draws: a graphics card draws the same faster. What an almost empty page takes is measured beside it, because
no content can be faster than that. The contents are made up (`doojax.viewer.examples`).
"""

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from doojax.benchmarks.medians import median_row
from doojax.commands import command_line
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.experiments.trials.record_files import save_record
from doojax.viewer import colours
from doojax.viewer.app import App
from doojax.viewer.browser import open_browser, open_page
from doojax.viewer.examples import trial_record, write_dataset, write_long_list
from doojax.viewer.page import Page as Viewed
from doojax.viewer.page import Server, start_server

if TYPE_CHECKING:
    from playwright.sync_api import Page

SEED = 2
TRAJECTORIES = 10_000
TRIALS = 10_000
NODES = 20_000
OPENINGS = 7
CHANGES = 40
SECONDS = 8.0  # for which the tree is turned
SOFTWARE = {"renderer": "software", "page": "1280x800"}

# Keeps what was drawn readable, and notes the frames in which a large tree was drawn.
WATCH = """
let gl = null;
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function(kind, options) {
  const context = getContext.call(this, kind, {...options, preserveDrawingBuffer: true});
  if (kind === "webgl2") gl = context;
  return context;
};
const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
window.treeFrames = new Set();
WebGL2RenderingContext.prototype.drawElementsInstanced = function(mode, count, type, offset, instances) {
  if (instances > 10000) window.treeFrames.add(document.timeline.currentTime);
  return draw.call(this, mode, count, type, offset, instances);
};
let pixels = new Uint32Array(0);
window.picture = () => {
  const width = gl.drawingBufferWidth, height = gl.drawingBufferHeight;
  if (pixels.length !== width * height) pixels = new Uint32Array(width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(pixels.buffer));
  const time = performance.now();  // all that was asked for has been drawn by now
  let hash = 0;
  for (const pixel of pixels) hash = (Math.imul(hash, 31) + pixel) | 0;
  return {hash, time};
};
const frame = () => new Promise(requestAnimationFrame);
// What runs in a frame, React's part of it included, has run.
window.afterFrame = () => frame().then(() => new Promise(done => {
  const channel = new MessageChannel();
  channel.port1.onmessage = done;
  channel.port2.postMessage(null);
}));
window.patience = 20000;  // ms
window.changed = async before => {
  const start = performance.now();
  for (;;) {
    const {hash, time} = window.picture();
    if (hash !== before) return time;
    if (time - start > window.patience) throw new Error("the picture stayed the same");
    await window.afterFrame();
  }
};
window.settled = async () => {
  const start = performance.now();
  for (let last = null, same = 0; same < 6; await new Promise(done => setTimeout(done, 70))) {
    const {hash, time} = window.picture();
    if (time - start > window.patience) throw new Error("the picture kept changing");
    same = hash === last ? same + 1 : 0;
    last = hash;
  }
};
window.place = node => window.__viserMutable.nodeRefFromName[node]?.position.toArray().join();
"""
# Presses the key that steps by one state. Returns the milliseconds until a node's new place has arrived and
# is that of its mesh in the page, and until the picture is another.
CHANGE = """async ([letter, node]) => {
  await window.settled();
  const key = {key: letter.toLowerCase(), code: "Key" + letter, bubbles: true};
  const before = window.picture().hash, old = window.place(node), start = performance.now();
  document.body.dispatchEvent(new KeyboardEvent("keydown", key));
  document.body.dispatchEvent(new KeyboardEvent("keyup", key));
  while (window.place(node) === old) {
    if (performance.now() - start > window.patience) throw new Error("no new place came");
    await window.afterFrame();
  }
  const arrival = performance.now();
  return [arrival - start, await window.changed(before) - start];
}"""
# Waits for what comes next. Seconds, of the clock that Python reads too.
NEXT = """async () => {
  await window.settled();
  window.next = window.changed(window.picture().hash).then(end => (performance.timeOrigin + end) / 1000);
}"""


def viewer(*, json: bool = False, publish: Path | None = None) -> None:
    """Measure the page of `doojax view` in a headless Chromium.

    open_s: from the opening of a data set, or of an evaluation's trials, by the server until the first rope
    is drawn in a page that was open before. frame_ms: from the key that steps in time until the rope's new
    place is in the page (arrival) and until another picture is drawn there (pixels); and the latter in a
    page that shows nothing but a short rope (floor), which is what viser and the browser take. tree_fps:
    frames a second that were drawn while the mouse turned the view of a search tree. Tags say whether it was
    a data set (trajectories) or an evaluation (trials).

    Args:
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/viewer; by
            default they are only shown.

    Raises:
        FileNotFoundError: there is no Chromium; the message says how to get it.
    """
    command = command_line(viewer, locals())
    server = start_server("127.0.0.1", 0)
    try:
        with tempfile.TemporaryDirectory() as temporary, open_browser() as browser:
            folder = Path(temporary)
            write_dataset(folder / "towed", TRAJECTORIES)
            write_long_list(folder / "trials", TRIALS)
            save_record(folder / "trial.npz", trial_record(seed=SEED, nodes=NODES))
            app = App(server, folder / "towed")
            page = open_page(browser, server.get_port(), script=WATCH)
            rows = changing(page, "/shown0/now/grippers/0", {"trajectories": TRAJECTORIES})
            app.close()
            rows.append(changing_least(server, page))
            rows.append(opening(server, page, folder / "towed", {"trajectories": TRAJECTORIES}))
            rows.append(opening(server, page, folder / "trials", {"trials": TRIALS}))
            app = App(server, folder / "trials")
            page.get_by_text("Read again").wait_for()
            rows += changing(page, "/now/grippers/0", {"trials": TRIALS})
            app.close()
            rows.append(turning(server, page, folder / "trial.npz"))
    finally:
        server.stop()
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    show(rows, json)


def changing(page: "Page", node: str, what: dict[str, int]) -> list[Row]:
    """Step to and fro in time, in a page where a node moves."""
    found = stepped(page, node)
    return [
        median_row("frame_ms", {**what, **SOFTWARE, "part": part}, times, "ms")
        for part, times in zip(("arrival", "pixels"), found.T, strict=True)
    ]


def changing_least(server: Server, page: "Page") -> Row:
    """The same in a page that shows nothing but a rope of two points."""
    viewed = Viewed(server)
    page.get_by_text("Read again").wait_for(state="hidden")
    rope, colour = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), colours.ROPE
    viewed.look_at(np.concatenate([rope - 0.1, rope + 0.1]).astype(np.float32), from_above=False)

    def move(step: float) -> None:
        rope[:, 2] += step
        viewed.drawing.rope("least", rope, radius=0.01, colour=colour)

    viewed.key("Up", "L", lambda: move(0.001))
    viewed.key("Down", "J", lambda: move(-0.001))
    viewed.call(lambda: move(0.0))
    page.wait_for_function("window.__viserMutable.nodeRefFromName['/least/0']")
    return median_row("frame_ms", {"part": "floor", **SOFTWARE}, stepped(page, "/least/0")[:, 1], "ms")


def stepped(page: "Page", node: str) -> Float[np.ndarray, "k 2"]:
    """Milliseconds from each of many keys to a node's new place, and to the new picture."""
    letters = ["L" if step // 3 % 2 == 0 else "J" for step in range(CHANGES)]  # a trial may be short
    return np.array([page.evaluate(CHANGE, [letter, node]) for letter in letters])


def opening(server: Server, page: "Page", path: Path, what: dict[str, int]) -> Row:
    """Open something again and again, in a page that shows nothing before."""
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
    return median_row("open_s", {**what, **SOFTWARE}, np.array(found), "s")


def turning(server: Server, page: "Page", path: Path) -> Row:
    """Turn the view of a search tree with the mouse."""
    app = App(server, path)
    page.get_by_role("tab", name="Search").click()
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
