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
from doojax.viewer.addresses import asked_for
from doojax.viewer.draw import SceneDrawing
from doojax.viewer.pictures import FROM_SIDE, camera_from
from doojax.viewer.text import plain

EXPECTED = (ValueError, OSError, IndexError, KeyError)  # bad input: reported, and the page lives on
FIELD_OF_VIEW = 0.62  # rad, vertical
STEEP = np.array([0.0, -0.48, 1.0]) / np.linalg.norm([0.0, -0.48, 1.0])  # where what is flat is seen from
AMBIENT, SUN = 1.2, 2.2  # of viser's lights
TOWARDS_SUN = (-0.6, -1.0, 2.2)


USUAL = 880, 800  # pixels of the scene in a page of 1280 x 800, beside the controls
NEAR = 1e-3  # m
NEAREST = 0.01  # m, of what a camera sees; viser's own
FROM_TOP = np.array([0.0, -1e-3, 1.0])
NARROW = 576  # pixels: up to this width viser puts the controls over the scene's lower part
UPRIGHT = 1.5  # times as high as wide: a telephone held upright
UNCOVERED = 0.4  # of the height is left above them


class Server(viser.ViserServer):
    """A viser server that never opens a tunnel to the internet.

    Attributes:
        on_resize: called for everybody who comes, and when the size of somebody's scene changes.
        on_address: called for everybody who comes by an address that says what to show.
    """

    on_resize: Callable[[viser.ClientHandle], None] | None = None
    on_address: Callable[[viser.ClientHandle, dict[str, str]], None] | None = None

    def resized(self, client: viser.ClientHandle) -> None:
        """Somebody has come, or moved the camera, or has another size now."""
        if self.on_resize is not None:
            self.on_resize(client)

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refused: data are shown only on the address that the server is bound to."""
        return None

    def stop(self) -> None:
        """Stop serving, without viser's farewell."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()


def start_server(host: str, port: int) -> Server:
    """Bind a server to an address.

    Raises:
        ValueError: for a port that no machine has, or no address.
        OSError: the address does not exist, or the port is taken.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"the port is {port}, expected 0 to 65535")
    if not host.strip():
        raise ValueError("the host is empty; name the address to bind to, such as 127.0.0.1")
    # viser would try a thousand ports, and wait for ever where none can be had
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, UnicodeError) as error:  # UnicodeError: a name that no address can have
            problem = f"cannot serve on {host}, port {port}: {getattr(error, 'strerror', None) or error}"
            raise OSError(f"{problem}; choose another with --host or --port") from error
    with contextlib.redirect_stdout(io.StringIO()):  # viser's own greeting
        server = Server(host=host, port=port, label="doojax", verbose=False)

    def come(client: viser.ClientHandle) -> None:
        server.resized(client)
        client.camera.on_update(lambda _: server.resized(client))
        query = asked_for(client)
        if query and server.on_address is not None:
            server.on_address(client, query)

    server.on_client_connect(come)
    return server


class Page:
    """One page for all who look at it: they see the same moment of the same thing.

    Attributes:
        server: the page's server.
        lock: held while anything is changed.
        drawing: the world's scene.
    """

    def __init__(self, server: Server):
        """An empty page."""
        self.server = server
        self.lock = threading.RLock()
        self.drawing = SceneDrawing(server.scene)
        self._console = Console(stderr=True, soft_wrap=True)
        self._seen: tuple[np.ndarray, np.ndarray] | None = None  # corners, and where they are seen from
        self._cut: float | None = None  # m, above which nothing is seen
        self.shown: dict[str, object] = {}  # what an address must say to lead to this content
        self._fitted: dict[
            int, tuple[tuple[int, int], np.ndarray]
        ] = {}  # client: size, where its camera was put
        self._eyes: list[np.ndarray] = []  # where any camera was put
        self.clear()
        server.on_resize = self._refit
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

    def call(self, action: Callable[[], None], aloud: bool = True) -> None:
        """Run ``action`` alone, send what it changes in one piece and show its error, if any.

        Only ``aloud`` the terminal hears of it, too.
        """
        with self.lock:
            try:
                with self.server.atomic():
                    action()
            except EXPECTED as error:
                self.report(error, aloud)
        self.server.flush()

    def key(self, text: str, key: Any, action: Callable[[], None]) -> None:
        """Let a key of the keyboard call ``action``; Ctrl-K in the page lists them all with their texts."""
        self.server.gui.add_command(text, hotkey=key).on_trigger(self.calling(action))

    def report(self, error: Exception | str, aloud: bool = True) -> None:
        """Say in the page and, aloud, on the terminal what is wrong, until `quiet`."""
        self._say(self.message, str(error.args[0]) if isinstance(error, KeyError) else str(error), aloud)

    def quiet(self) -> None:
        """Take the last message away: it no longer holds."""
        self.message.visible = False

    def warn(self, text: str, again: bool = True) -> None:
        """Say in the page and on the terminal what holds for as long as this content is shown.

        Without ``again`` the terminal hears it once, however often it changes.
        """
        self._say(self.warning, text, again or not self.warning.visible)

    def _say(self, place: viser.GuiMarkdownHandle, text: str, aloud: bool = True) -> None:
        if aloud:
            self._console.print(f"[yellow]doojax view: {escape(text)}[/]", highlight=False)
        place.content = "\n".join(f"> **{plain(line)}**  " for line in text.splitlines())
        place.visible = True

    def stage(self, corners: Float[np.ndarray, "K 3"], floor: float | None, from_above: bool) -> None:
        """Floor (height, m), axes and camera for something that reaches around all of some points."""
        low, high = corners.min(0), corners.max(0)
        height = float(low[2]) if floor is None else floor
        # not viser's grid, whose every pixel a shader computes: in software that doubles a picture's time
        fine, coarse = floor_lines(low, high, height - 0.001)
        self.drawing.lines("floor/fine", fine, width=1.0, colours=(226, 229, 234))
        self.drawing.lines("floor/coarse", coarse, width=1.5, colours=(203, 208, 216))
        corner = np.array([*(low[:2] - 0.15), height])
        self.drawing.axes("axes", corner, np.array([1.0, 0.0, 0.0, 0.0]), length=0.15)
        self.look_at(np.append(corners, corner[None], axis=0), from_above)

    def look_at(self, corners: Float[np.ndarray, "K 3"], from_above: bool) -> None:
        """Have everybody see all of some points, and those who come later too."""
        self._usual = STEEP if from_above else FROM_SIDE
        self._eyes = []
        self._look(corners, self._usual, None)

    def turn(self, from_top: bool, cut: float | None = None) -> None:
        """Have everybody look straight down, or as usual; looking down, nothing above ``cut`` (m) is seen.

        Raises ValueError before `look_at` has said what there is to see.
        """
        if self._seen is None:
            raise ValueError("there is nothing to look at yet: call look_at first")
        direction = FROM_TOP / np.linalg.norm(FROM_TOP) if from_top else self._usual
        self._look(self._seen[0], direction, cut if from_top else None)

    def height_at(self, part: float) -> float:
        """A height (m), at a part of the way from the lowest to the highest of what is shown."""
        if self._seen is None:
            raise ValueError("there is nothing to look at yet: call look_at first")
        low, high = self._seen[0][:, 2].min(), self._seen[0][:, 2].max()
        return float(low + part * (high - low))

    def _look(self, corners: np.ndarray, direction: np.ndarray, cut: float | None) -> None:
        self._seen, self._cut = (corners, direction), cut
        eye, target = self.view(*USUAL)
        self._eyes.append(eye)
        first = self.server.initial_camera
        first.position, first.look_at, first.near = eye, target, self._nearest(eye)
        self.fit_view()

    def _nearest(self, eye: Float[np.ndarray, "3"]) -> float:
        """How far (m) from the eye what is seen begins: below the cut, if there is one."""
        return NEAREST if self._cut is None else max(float(eye[2]) - self._cut, NEAREST)

    def view(self, width: int, height: int) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Where a camera has to be, and look, to see everything in a scene of so many pixels.

        Raises ValueError before `look_at` has said what there is to see.
        """
        if self._seen is None:
            raise ValueError("there is nothing to look at yet: call look_at first")
        corners, direction = self._seen
        # controls lie beside the scene in wider pages, whose scene is narrow, too, but seldom so high
        visible = UNCOVERED if width <= NARROW and height > UPRIGHT * width else 1.0
        camera = camera_from(direction, corners, width, height, margin=1.12, visible=visible)
        middle = (corners.min(0) + corners.max(0)) / 2
        ahead = camera.axes[2] * float(np.linalg.norm(middle - camera.eye))
        return camera.eye.astype(float), (camera.eye + ahead).astype(float)

    def fit_view(self) -> None:
        """Turn everybody's camera back to where it shows everything."""
        for client in self.server.get_clients().values():
            self._fit(client)

    def _fit(self, client: viser.ClientHandle) -> None:
        size = client.camera.image_width, client.camera.image_height
        if self._seen is None or min(size) < 1:
            return
        eye, target = self.view(*size)
        self._fitted[client.client_id] = size, eye
        self._eyes.append(eye)
        client.camera.position, client.camera.look_at = eye, target
        client.camera.near = self._nearest(eye)

    def put(self, client: viser.ClientHandle, eye: np.ndarray, target: np.ndarray) -> None:
        """Move somebody's camera to a place (m), as if by hand: it stays there."""
        self._fitted[client.client_id] = (0, 0), np.full(3, np.inf)
        client.camera.position, client.camera.look_at = eye, target

    def _refit(self, client: viser.ClientHandle) -> None:
        """Show everything to somebody whose scene has another size, unless the view was turned by hand."""
        with self.lock:
            eye = client.camera.position
            size, put = self._fitted.get(client.client_id, (None, None))
            same = size == (client.camera.image_width, client.camera.image_height)
            if put is None or (
                not (same and near(eye, put)) and any(near(eye, other) for other in self._eyes)
            ):
                self._fit(client)


def near(place: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> bool:
    """Are two places of a camera the same, but for rounding?"""
    return bool(np.linalg.norm(place - other) < NEAR)


def floor_lines(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], height: float
) -> tuple[Float[np.ndarray, "K 2 3"], Float[np.ndarray, "L 2 3"]]:
    """The lines of a floor that reaches half a metre around everything: each 10 cm, and each 50 cm."""
    first, last = np.floor(2 * low[:2] - 1).astype(int) * 5, np.ceil(2 * high[:2] + 1).astype(int) * 5
    lines, whole = [], []
    for axis in (0, 1):
        at = np.arange(first[axis], last[axis] + 1)
        ends = np.empty((len(at), 2, 3))
        ends[..., axis], ends[..., 2] = at[:, None] / 10, height
        ends[:, 0, 1 - axis], ends[:, 1, 1 - axis] = first[1 - axis] / 10, last[1 - axis] / 10
        lines.append(ends)
        whole.append(at % 5 == 0)
    every, coarse = np.concatenate(lines), np.concatenate(whole)
    return every[~coarse], every[coarse]
