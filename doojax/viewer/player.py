"""Time in the page: a slider, play, speed, loop and the keyboard."""

import threading
import time
from collections.abc import Callable

import viser

from doojax.viewer.page import Page

TICK = 1 / 20  # s between two frames while playing
SPEEDS = ("0.5", "1", "2", "4", "8", "16")  # states per second


class Player:
    """Shows moments: whole states by slider and keys, moments between two states while playing.

    Keys: space plays and pauses; J and L step; home and end jump. (The arrow keys turn viser's camera.)
    """

    def __init__(self, page: Page, show: Callable[[float], None], label: str = "State"):
        """Add the controls to the page's current folder.

        Args:
            page: where to.
            show: draws a moment, a number of states from 0 on.
            label: the slider's.
        """
        gui = page.server.gui
        self._page, self._show = page, show
        self._last = 1
        self._moment = 0.0
        self._stopped = threading.Event()
        self.slider = gui.add_slider(label, min=0, max=1, step=1, initial_value=0, hint="Keys: J and L")
        self.play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY, hint="Key: space")
        self.speed = gui.add_dropdown("States per second", SPEEDS, initial_value="4")
        self.loop = gui.add_checkbox("Loop", initial_value=True)
        self.playing = False
        self.slider.on_update(self._slid)
        self.play.on_click(page.calling(self.toggle))
        page.key("Play or pause", "space", self.toggle)
        page.key("Previous state", "J", lambda: self.step(-1))
        page.key("Next state", "L", lambda: self.step(1))
        page.key("First state", "home", lambda: self.go_to(0.0))
        page.key("Last state", "end", lambda: self.go_to(float(self._last)))
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    @property
    def moment(self) -> float:
        """What is shown, in states from the first."""
        return self._moment

    def set_states(self, count: int) -> None:
        """There are ``count`` states now; the moment stays where it can."""
        self._last = max(count - 1, 0)
        self.slider.max = max(self._last, 1)
        self.slider.disabled = self._last == 0
        self._moment = min(self._moment, float(self._last))
        self.slider.value = int(self._moment)

    def go_to(self, moment: float) -> None:
        """Show a moment, unless the controls are gone and this comes too late."""
        if self._stopped.is_set():
            return
        self._moment = min(max(moment, 0.0), float(self._last))
        self.slider.value = int(self._moment)
        self._show(self._moment)

    def step(self, states: int) -> None:
        """Go to a neighbouring state and stay there."""
        self.pause()
        self.go_to(float(int(self._moment) + states))

    def toggle(self) -> None:
        """Play or pause; from the end, play again from the beginning."""
        if self.playing:
            self.pause()
            return
        if self._moment >= self._last:
            self._moment = 0.0
        self.playing = True
        self.play.label, self.play.icon = "Pause", viser.Icon.PLAYER_PAUSE

    def pause(self) -> None:
        """Stop playing."""
        self.playing = False
        self.play.label, self.play.icon = "Play", viser.Icon.PLAYER_PLAY

    def stop(self) -> None:
        """End for good: the controls are about to be removed."""
        self._stopped.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=2)

    def _slid(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # by hand, not by `go_to`
            self._page.call(lambda: self.go_to(float(self.slider.value)))

    def _run(self) -> None:
        before = time.monotonic()
        while not self._stopped.wait(TICK):
            now = time.monotonic()
            passed, before = now - before, now
            if self.playing:
                self._page.call(lambda passed=passed: self._play_on(passed))

    def _play_on(self, passed: float) -> None:
        if not self.playing or self._stopped.is_set():
            return
        moment = self._moment + passed * float(self.speed.value)
        if moment >= self._last and not self.loop.value:
            self.pause()
        elif moment >= self._last + 1:  # the last state stays for as long as a step takes
            moment = 0.0
        playing, self.playing = self.playing, False  # should showing it fail, it stays paused
        self.go_to(moment)
        self._moment, self.playing = min(moment, self._last + 1.0), playing
