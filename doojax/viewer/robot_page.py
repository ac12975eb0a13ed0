"""A robot in the page: sliders that move its joints, whether it is free, targets of its tools."""

import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import viser
from jaxtyping import Float

from doojax.geometry.shapes import FAR
from doojax.keys import stream
from doojax.robots import IkSettings, Robot, inverse_kinematics
from doojax.viewer.episodes import no_obstacles
from doojax.viewer.page import Page
from doojax.viewer.robots import LINK, TOUCHES, Posture, box_of, ends_of, posture, robot_shapes, show_robot
from doojax.viewer.text import legend, plain, shortened

TURN, SHIFT = np.pi, 1.0  # rad and m, that sliders reach where a joint has no limits
HANDLE = 0.14  # m, of what a target is dragged by
REACH = 0.3  # of the robot's size, that is left around it
STARTS = IkSettings(starts=32)


class RobotPage:
    """The controls and the scene of one robot, in its base's frame.

    The floor is at the lowest of what does not move; a robot of which everything moves has none.
    """

    def __init__(self, page: Page, robot: Robot, path: Path):
        """Show the zero posture."""
        self._page, self._robot = page, robot
        self.joints = np.asarray(robot.zero, np.float32)
        self._floor, self._nothing = floor_of(robot), no_obstacles()
        self._posture = eqx.filter_jit(posture)
        self._solve = eqx.filter_jit(inverse_kinematics)
        self._asked, self._closed = 0, False
        gui = page.server.gui
        self._heading = f"**{plain(path.stem.replace('_', ' '))}**  \n{plain(shortened(path))}"
        gui.add_markdown(self._heading)
        self._facts = gui.add_markdown("")
        gui.add_html(legend({"link": LINK, "touches": TOUCHES}))
        tabs = gui.add_tab_group()
        self.sliders: list[viser.GuiSliderHandle] = []
        self.targets: list[viser.TransformControlsHandle] = []
        with tabs.add_tab("Joints"):
            for number, name in enumerate(robot.joints):
                self.sliders.append(self._slider(number, name))
            zero = gui.add_button("Zero")
        with tabs.add_tab("Tools"):
            gui.add_markdown(
                "Drag a target by its arrows, then solve for the joints that bring its tool there. "
                "Those that tools share move the others, too."
            )
            self._turned = gui.add_checkbox("Turn it, too", initial_value=False)
            for number, name in enumerate(robot.tools):
                solve = gui.add_button(f"Solve {name}", icon=viser.Icon.TARGET)
                solve.on_click(page.calling(partial(self.solve, number)))
            back = gui.add_button("Targets to their tools")
        for slider in self.sliders:
            slider.on_update(self._slid)
        zero.on_click(page.calling(lambda: self.set(np.asarray(robot.zero, np.float32))))
        back.on_click(page.calling(self._fetch))
        page.stage(corners_of(robot, ends_of(robot, self.joints)), self._floor, from_above=False)
        show_robot(page.drawing, "robot", robot, ends_of(robot, self.joints))
        self._facts.content = "distances are being compiled"
        # beside, for that takes seconds
        self.begun = threading.Thread(target=lambda: page.call(self._begin), name="robot", daemon=True)
        self.begun.start()

    def close(self) -> None:
        """What is being compiled is not shown any more."""
        self._closed = True

    def go(self, wanted: Mapping[str, str]) -> None:
        """A robot has no address but its own."""

    def set(self, joints: Float[np.ndarray, "J"]) -> None:
        """Move the robot, and its sliders."""
        self.joints = joints
        for slider, value in zip(self.sliders, joints, strict=True):
            slider.value = shown_by(slider, float(value))
        self._show()

    def solve(self, tool: int) -> None:
        """Move the robot so that a tool is at its target; of several postures, the nearest that is free.

        Raises:
            ValueError: no start of the search leads there; the message says how near the tool comes. The
                robot stays.
        """
        robot, target = self._robot, self.targets[tool]
        self._asked += 1
        quaternion = jnp.asarray(target.wxyz, jnp.float32) if self._turned.value else None
        found = self._solve(
            robot,
            robot.tools[tool],
            jnp.asarray(target.position, jnp.float32),
            jnp.asarray(self.joints),
            stream(0, "viewer", "robot", str(self._asked)),
            quaternion,
            STARTS,
        )
        found.check()
        self._page.quiet()
        several = np.asarray(found.joints)[np.asarray(found.solved)]
        free = (joints for joints in several if self._at(joints).clearance > 0)
        self.set(next(free, several[0]))

    def _slider(self, number: int, name: str) -> viser.GuiSliderHandle:
        robot = self._robot
        usual = SHIFT if robot.slides[number] else TURN
        zero = float(robot.zero[number])
        low, high = float(robot.low[number]), float(robot.high[number])
        low, high = (
            max(low, zero - usual) if np.isinf(low) else low,
            high if np.isfinite(high) else zero + usual,
        )
        return self._page.server.gui.add_slider(
            name,
            min=low,
            max=high,
            step=1e-3,
            initial_value=float(np.clip(zero, low, high)),
            hint=f"{low:.3g} to {high:.3g} {'m' if robot.slides[number] else 'rad'}",
        )

    def _slid(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # by hand, not by `set`
            self._page.call(self._read)

    def _read(self) -> None:
        pairs = zip(self.joints.tolist(), self.sliders, strict=True)
        self.joints = np.array(
            [old if slider.value == shown_by(slider, float(old)) else slider.value for old, slider in pairs],
            np.float32,
        )
        self._show()

    def _at(self, joints: Float[np.ndarray, "J"]) -> Posture:
        found = self._posture(self._robot, jnp.asarray(joints), self._nothing, self._floor)
        return jax.tree.map(np.asarray, found)

    def _begin(self) -> None:
        if self._closed:
            return
        now = self._at(self.joints)
        for name, place, turn in zip(self._robot.tools, now.tools, now.turns, strict=True):
            self.targets.append(
                self._page.server.scene.add_transform_controls(
                    f"/targets/{name}", scale=HANDLE, position=place, wxyz=turn, depth_test=False
                )
            )
        self._show()

    def _fetch(self) -> None:
        now = self._at(self.joints)
        for target, place, turn in zip(self.targets, now.tools, now.turns, strict=True):
            target.position, target.wxyz = place, turn

    def _show(self) -> None:
        now, drawing = self._at(self.joints), self._page.drawing
        show_robot(drawing, "robot", self._robot, now.ends, touching=now.apart <= 0)
        lines = [said_of(now.clearance)]
        for name, place, turn in zip(self._robot.tools, now.tools, now.turns, strict=True):
            drawing.axes(f"tools/{name}", place, turn, length=HANDLE / 2)
            x, y, z = place
            lines.append(f"{plain(name)}: x {x:.3f}, y {y:.3f}, z {z:.3f} m")
        self._facts.content = "  \n".join(lines)


def shown_by(slider: viser.GuiSliderHandle, value: float) -> float:
    """What a slider shows of a joint's value: no more digits than there is room for."""
    return round(float(np.clip(value, slider.min, slider.max)), 3)


def said_of(clearance: float) -> str:
    """Whether a robot with such a clearance (m) is free, as Markdown."""
    if clearance > FAR / 2:
        return "free: there is nothing that it could touch"
    if clearance > 0:
        return f"free: {1000 * clearance:.0f} mm to what is nearest"
    return f"**not free**: {-1000 * clearance:.0f} mm deep in itself or in the floor"


def floor_of(robot: Robot) -> float | None:
    """The height (m, base's frame) of the lowest of what does not move; None where everything does."""
    if not robot.base.kind.size:
        return None
    return float(box_of(robot.base)[0][2])


def corners_of(robot: Robot, ends: Float[np.ndarray, "2 S 3"]) -> Float[np.ndarray, "2 3"]:
    """Two corners of a box around a robot, with room to move."""
    shapes = jax.tree.map(lambda *both: jnp.concatenate(both), robot_shapes(robot, ends), robot.base)
    if not shapes.kind.size:
        raise ValueError("the robot has no shapes that collide: there is nothing of it to show")
    low, high = box_of(shapes)
    room = REACH * float((high - low).max())
    return np.stack([low - room, high + room]).astype(np.float32)
