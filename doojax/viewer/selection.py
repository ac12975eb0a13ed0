"""Filter and sort in the page, by a column of numbers."""

from collections.abc import Callable, Sequence

import numpy as np
import viser
from jaxtyping import Float

from doojax.viewer.columns import select
from doojax.viewer.page import Page
from doojax.viewer.plots import Histogram

NO_COLUMN = "(none)"
ORDERS = ("as stored", "ascending", "descending")


class Selection:
    """Which of n items are gone through, in which order; and how the column that says so is spread.

    Attributes:
        pick: the slider that goes through them, made by `add_pick`.
        order: the items let through, in order.
    """

    def __init__(self, page: Page, count: int, noun: str, on_pick: Callable[[], None]):
        """Add the slider to the page's current folder; `add_controls` adds the rest.

        Args:
            page: where to.
            count: how many items there are.
            noun: what one is called, such as "trajectory".
            on_pick: called when another item is picked, or the order has changed.
        """
        self._page, self._count, self._on_pick = page, count, on_pick
        self.order = np.arange(count)
        self.pick = page.server.gui.add_slider(
            noun.capitalize(), min=0, max=max(count - 1, 1), step=1, initial_value=0, hint="Keys: I and K"
        )
        self.pick.on_update(page.calling(on_pick))
        page.key(f"Previous {noun}", "I", lambda: self._go(-1))
        page.key(f"Next {noun}", "K", lambda: self._go(1))

    @property
    def place(self) -> int:
        """The picked place in ``order``."""
        return int(np.clip(self.pick.value, 0, max(len(self.order) - 1, 0)))

    def add_controls(
        self, names: Sequence[str], values: Callable[[str], Float[np.ndarray, "n"]], nouns: str
    ) -> None:
        """Add what filters and sorts to the page's current folder.

        Args:
            names: of the columns.
            values: gives a column, one number for each item, NaN for none.
            nouns: what the items are called, such as "trajectories".
        """
        page, gui = self._page, self._page.server.gui
        self._values, self._nouns = values, nouns
        self._column = gui.add_dropdown("By", (NO_COLUMN, *names))
        self._low = gui.add_number("From", 0.0, step=0.001, disabled=True)
        self._high = gui.add_number("To", 0.0, step=0.001, disabled=True)
        self._order = gui.add_dropdown("Order", ORDERS, disabled=True)
        self._counted = gui.add_markdown("")
        self._histogram = Histogram(gui)
        self._column.on_update(page.calling(self._column_chosen))
        for control in (self._low, self._high, self._order):
            control.on_update(self._by_hand)
        self._say_count()

    def go_to(self, item: int) -> None:
        """Pick an item; a filter that holds it back is taken away.

        Raises ValueError where there is no such item.
        """
        if not 0 <= item < self._count:
            raise ValueError(f"there is no item {item}: expected 0 to {self._count - 1}")
        places = np.flatnonzero(self.order == item)
        if not len(places):
            self._column.value = NO_COLUMN
            self._column_chosen()
            places = np.flatnonzero(self.order == item)
        if self.place != places[0]:
            self.pick.value = int(places[0])
            self._on_pick()

    def _go(self, steps: int) -> None:
        self.pick.value = int(np.clip(self.place + steps, 0, max(len(self.order) - 1, 0)))

    def _by_hand(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # not by `_column_chosen`
            self._page.call(self._apply)

    def _column_chosen(self) -> None:
        name = self._column.value
        off = name == NO_COLUMN
        for control in (self._low, self._high, self._order):
            control.disabled = off
        if not off:
            values = self._values(name)
            finite = values[np.isfinite(values)]
            # outwards to what the boxes show
            self._low.value = float(np.floor(1000 * finite.min()) / 1000) if finite.size else 0.0
            self._high.value = float(np.ceil(1000 * finite.max()) / 1000) if finite.size else 0.0
        self._apply()

    def _apply(self) -> None:
        name = self._column.value
        if name == NO_COLUMN:
            self.order = np.arange(self._count)
            self._histogram.set("", np.zeros(0), np.zeros(0))
        else:
            values = self._values(name)
            self.order = select(values, float(self._low.value), float(self._high.value), self._order.value)
            self._histogram.set(name, values, values[self.order])
        self._say_count()
        self.pick.max = max(len(self.order) - 1, 1)
        if self.pick.value == 0:
            self._on_pick()
        else:
            self.pick.value = 0

    def _say_count(self) -> None:
        self._counted.content = f"{len(self.order)} of {self._count} {self._nouns}"
