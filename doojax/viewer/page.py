"""The page that every kind of content is shown in: server, scene, messages, camera."""

import contextlib
import io
import socket
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from rich.console import Console
from rich.markup import escape

from doojax.viewer import colours
from doojax.viewer.draw import SceneDrawing
from doojax.viewer.pictures import FROM_SIDE, camera_from
from doojax.viewer.text import plain

EXPECTED = (ValueError, OSError, IndexError, KeyError)  # bad input: reported, and the page lives on
FIELD_OF_VIEW = 0.62  # rad, vertical
STEEP = np.array([0.0, -0.48, 1.0]) / np.linalg.norm([0.0, -0.48, 1.0])  # where what is flat is seen from
AMBIENT, SUN = 1.2, 2.2  # of viser's lights
TOWARDS_SUN = (-0.6, -1.0, 2.2)


class Server(viser.ViserServer):
    """A viser server that never opens a tunnel to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refused: data are shown only on the address that the server is bound to."""
        return None

    def stop(self) -> None:
        """Stop serving, without viser's farewell."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()


def start_server(host: str, port: int) -> Server:
    """Bind a server to an address.

    Raises OSError where the address does not exist or the port is taken.
    """
    # viser would try a thousand ports, and wait for ever where none can be had
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            problem = f"cannot serve on {host}, port {port}: {error.strerror}"
            raise OSError(f"{problem}; choose another with --host or --port") from error
    with contextlib.redirect_stdout(io.StringIO()):  # viser's own greeting
        return Server(host=host, port=port, label="doojax", verbose=False)


class Page:
    """One page for all who look at it: they see the same moment of the same thing.

    Attributes:
        server: the page's server.
        lock: held while anything is changed.
        drawing: the world's scene.
    """

    def __init__(self, server: viser.ViserServer):
        """An empty page."""
        self.server = server
        self.lock = threading.RLock()
        self.drawing = SceneDrawing(server.scene)
        self._console = Console(stderr=True, soft_wrap=True)
        self._camera: tuple[np.ndarray, np.ndarray] | None = None
        self.clear()
        server.gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="large", brand_color=colours.CHOSEN
        )
        server.initial_camera.fov = FIELD_OF_VIEW

    def clear(self) -> None:
        """Take everything away."""
        with self.lock:
            self.server.gui.reset()
            scene = self.server.scene
            scene.reset()
            scene.set_up_direction("+z")
            scene.configure_environment_map(hdri=None)  # which would bleach all colours
            scene.configure_default_lights(False)  # their shadows take longer to draw than all else
            scene.add_light_ambient("/light", intensity=AMBIENT)
            scene.add_light_directional("/sun", intensity=SUN, position=TOWARDS_SUN)
            self.server.gui.set_panel_label("doojax")
            self.server.gui.main_panel.dock_right()
            self.drawing = SceneDrawing(scene)
            self.message = self.server.gui.add_markdown("", visible=False)
            self.warning = self.server.gui.add_markdown("", visible=False)

    def calling(self, action: Callable[[], None]) -> Callable[[object], None]:
        """``action`` as a callback: alone, sent to the page in one piece, its errors shown."""

        def callback(_: object) -> None:
            self.call(action)

        return callback

    def call(self, action: Callable[[], None]) -> None:
        """Run ``action`` alone, send what it changes in one piece and show its error, if any."""
        with self.lock:
            try:
                with self.server.atomic():
                    action()
            except EXPECTED as error:
                self.report(error)
        self.server.flush()

    def key(self, text: str, key: Any, action: Callable[[], None]) -> None:
        """Let a key of the keyboard call ``action``; Ctrl-K in the page lists them all with their texts."""
        self.server.gui.add_command(text, hotkey=key).on_trigger(self.calling(action))

    def report(self, error: Exception | str) -> None:
        """Say in the page and on the terminal what is wrong, until `quiet`."""
        self._say(self.message, str(error.args[0]) if isinstance(error, KeyError) else str(error))

    def quiet(self) -> None:
        """Take the last message away: it no longer holds."""
        self.message.visible = False

    def warn(self, text: str) -> None:
        """Say in the page and on the terminal what holds for as long as this content is shown."""
        self._say(self.warning, text)

    def _say(self, place: viser.GuiMarkdownHandle, text: str) -> None:
        self._console.print(f"[yellow]doojax view: {escape(text)}[/]", highlight=False)
        place.content = "\n".join(f"> **{plain(line)}**  " for line in text.splitlines())
        place.visible = True

    def stage(self, corners: Float[np.ndarray, "K 3"], floor: float | None, from_above: bool) -> None:
        """Floor (height, m), axes and camera for something that reaches around all of some points."""
        low, high = corners.min(0), corners.max(0)
        height = float(low[2]) if floor is None else floor
        size, middle = np.ceil((high - low)[:2] + 1), ((low + high) / 2)[:2]
        scene = self.server.scene
        scene.add_grid(
            "/floor",
            width=float(size[0]),
            height=float(size[1]),
            cell_size=0.1,
            section_size=0.5,
            cell_color=(226, 229, 234),
            section_color=(203, 208, 216),
            plane_color=colours.FLOOR,
            plane_opacity=1.0,
            position=(float(middle[0]), float(middle[1]), height - 0.001),
        )
        corner = np.array([*(low[:2] - 0.15), height])
        self.drawing.axes("axes", corner, np.array([1.0, 0.0, 0.0, 0.0]), length=0.15)
        self.look_at(np.append(corners, corner[None], axis=0), from_above)

    def look_at(self, corners: Float[np.ndarray, "K 3"], from_above: bool) -> None:
        """Have everybody see all of some points, and those who come later too."""
        # for a page of 1280 x 800, beside the controls
        camera = camera_from(STEEP if from_above else FROM_SIDE, corners, 880, 800, margin=1.12)
        middle = (corners.min(0) + corners.max(0)) / 2
        ahead = camera.axes[2] * float(np.linalg.norm(middle - camera.eye))
        self._camera = camera.eye.astype(float), (camera.eye + ahead).astype(float)
        self.server.initial_camera.position = self._camera[0]
        self.server.initial_camera.look_at = self._camera[1]
        self.fit_view()

    def fit_view(self) -> None:
        """Turn everybody's camera back to where `look_at` put it."""
        if self._camera is not None:
            for client in self.server.get_clients().values():
                client.camera.position, client.camera.look_at = self._camera
