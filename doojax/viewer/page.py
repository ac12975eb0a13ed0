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
from doojax.viewer.pictures import camera_on

EXPECTED = (ValueError, OSError, IndexError, KeyError)  # bad input: reported, and the page lives on
FIELD_OF_VIEW = 0.62  # rad, vertical
AMBIENT = 1.3


class Server(viser.ViserServer):
    """A viser server that never opens a tunnel to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refused: data are shown only on the address that the server is bound to."""
        return None


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
            self.server.scene.reset()
            self.server.scene.set_up_direction("+z")
            self.server.scene.configure_environment_map(hdri=None)  # which would bleach all colours
            self.server.scene.add_light_ambient("/light", intensity=AMBIENT)
            self.server.gui.set_panel_label("doojax")
            self.server.gui.main_panel.dock_right()
            self.drawing = SceneDrawing(self.server.scene)
            self.message = self.server.gui.add_markdown("", visible=False)

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
        """Say in the page and on the terminal what is wrong."""
        text = str(error.args[0]) if isinstance(error, KeyError) else str(error)
        self._console.print(f"[yellow]doojax view: {escape(text)}[/]", highlight=False)
        self.message.content = "\n".join(f"> **{line}**  " for line in text.splitlines())
        self.message.visible = True

    def quiet(self) -> None:
        """Take the last message away: it no longer holds."""
        self.message.visible = False

    def stage(self, corners: Float[np.ndarray, "K 3"], floor: float | None, from_above: bool) -> None:
        """Floor (height, m), axes and camera for something that reaches around all of some points."""
        low, high = corners.min(0), corners.max(0)
        height = float(low[2]) if floor is None else floor
        size, middle = np.ceil((high - low)[:2] + 1), ((low + high) / 2)[:2]
        self.server.scene.add_grid(
            "/floor",
            width=float(size[0]),
            height=float(size[1]),
            cell_size=0.1,
            section_size=0.5,
            cell_color=(226, 229, 234),
            section_color=(203, 208, 216),
            plane_color=colours.FLOOR,
            plane_opacity=1.0,
            shadow_opacity=0.18,
            position=(float(middle[0]), float(middle[1]), height - 0.001),
        )
        corner = np.array([*(low[:2] - 0.15), height])
        self.drawing.axes("axes", corner, np.array([1.0, 0.0, 0.0, 0.0]), length=0.15)
        self.look_at(corners, from_above)

    def look_at(self, corners: Float[np.ndarray, "K 3"], from_above: bool) -> None:
        """Have everybody see all of some points, and those who come later too."""
        wide, high = 880, 800  # of a page of 1280 x 800 beside the controls
        low_corner, high_corner = corners.min(0), corners.max(0)
        target = (low_corner + high_corner) / 2
        side = camera_on(corners, False, wide, high, margin=1.15)
        if from_above:
            reach = 1.25 * float(np.linalg.norm((high_corner - low_corner)[:2])) / 2
            eye = target + np.array([0.0, -0.55, 1.0]) * reach / np.tan(FIELD_OF_VIEW / 2) / 1.3
        else:
            eye = side.eye
            target = eye + side.axes[2] * float(np.linalg.norm(target - eye))
        self._camera = np.asarray(eye, dtype=float), np.asarray(target, dtype=float)
        self.server.initial_camera.position = self._camera[0]
        self.server.initial_camera.look_at = self._camera[1]
        self.fit_view()

    def fit_view(self) -> None:
        """Turn everybody's camera back to where `look_at` put it."""
        if self._camera is not None:
            for client in self.server.get_clients().values():
                client.camera.position, client.camera.look_at = self._camera
