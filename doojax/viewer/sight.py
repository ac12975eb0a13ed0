"""Seeing through, from above and in section; pictures, films and addresses of what is shown."""

import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import viser
from PIL import Image

from doojax.experiments.drawing import Drawing
from doojax.types import Obstacles
from doojax.viewer import colours
from doojax.viewer.addresses import address, show_address
from doojax.viewer.films import Film
from doojax.viewer.page import Page
from doojax.viewer.pictures import animate
from doojax.viewer.recording import record

SIDE, TOP = "Usual", "Top"
WHOLE = 1.0  # of the height of what is shown: nothing is cut


class Sight:
    """How what is shown is looked at, and what may be taken home of it."""

    def __init__(
        self,
        page: Page,
        obstacles: Callable[[], Sequence[tuple[Drawing, Obstacles]]],
        film: Callable[[], Film],
        place: Callable[[], Mapping[str, object]],
        opacity: float = 1.0,
    ):
        """Add the controls to the page's current folder.

        Args:
            page: where to.
            obstacles: where and what stands around what is shown now.
            film: of what is shown now.
            place: what an address must say to lead here.
            opacity: of obstacles, at first.
        """
        gui = page.server.gui
        self._page, self._obstacles, self._film, self._place = page, obstacles, film, place
        self._opacity = gui.add_slider("Obstacles", min=0.0, max=1.0, step=0.05, initial_value=opacity)
        self._from = gui.add_button_group("Seen from", (SIDE, TOP))
        self._cut = gui.add_slider(
            "Cut at",
            min=0.0,
            max=WHOLE,
            step=0.02,
            initial_value=WHOLE,
            hint="Section: nothing above is seen",
        )
        self._save = gui.add_button_group("Save as", ("PNG", "GIF", "HTML"))
        self._address = gui.add_button("Address of this view", hint="Into the browser's address bar")
        self._link = gui.add_markdown("", visible=False)
        self._opacity.on_update(page.calling(self.draw))
        self._from.on_click(page.calling(self._turn))
        self._cut.on_update(page.calling(self._section))
        self._save.on_click(self._saved)
        self._address.on_click(self._addressed)

    def draw(self) -> None:
        """Draw the obstacles."""
        for drawing, obstacles in self._obstacles():
            self.draw_one(drawing, obstacles)

    def draw_one(self, drawing: Drawing, obstacles: Obstacles) -> None:
        """Draw obstacles, as opaque as they are to be."""
        opacity = float(self._opacity.value)
        if opacity == 0:
            drawing.remove("obstacles")
        else:
            drawing.obstacles("obstacles", obstacles, colour=colours.OBSTACLE, opacity=opacity)

    def _turn(self) -> None:
        self._cut.value = WHOLE
        self._page.turn(self._from.value == TOP)

    def _section(self) -> None:
        part = float(self._cut.value)
        if part < WHOLE:
            self._page.turn(True, self._page.height_at(part))

    def _addressed(self, event: viser.GuiEvent) -> None:
        with self._page.lock:
            query = address({**self._page.shown, **self._place()}, event.client)
            self._link.content = f"[this view]({query})"
            self._link.visible = True
        if event.client is not None:
            show_address(event.client, query)

    def _saved(self, event: viser.GuiEvent) -> None:
        client, ending = event.client, str(self._save.value).lower()
        if client is None:
            return
        name = f"doojax.{ending}"
        note = client.add_notification(name, "being made", loading=True, with_close_button=False)
        try:
            content = self._content(client, ending)
        except (ValueError, OSError, RuntimeError) as error:
            self._page.report(str(error))
        else:
            client.send_file_download(name, content, save_immediately=True)
        finally:
            note.remove()

    def _content(self, client: viser.ClientHandle, ending: str) -> bytes:
        if ending == "png":
            camera = client.camera
            pixels = client.get_render(camera.image_height, camera.image_width, timeout=60)
            file = io.BytesIO()
            Image.fromarray(np.asarray(pixels)[..., :3]).save(file, "PNG")
            return file.getvalue()
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / f"film.{ending}"
            film = self._film()
            animate(film, out) if ending == "gif" else record(film, out)
            return out.read_bytes()
