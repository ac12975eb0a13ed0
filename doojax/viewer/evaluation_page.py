"""The trials of an evaluation in the page: which method is better, where, and why each trial failed."""

import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import viser

from doojax.experiments.trials.evaluate import record_file
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.records import TrialRecord
from doojax.viewer import colours
from doojax.viewer.page import Page
from doojax.viewer.text import plain, shortened
from doojax.viewer.trial_table import ALL, SORTS, beside, choices, chosen, methods_of, rates, read_rows, table
from doojax.viewer.trial_view import TrialView

LOOK_AGAIN = 2.0  # s


class EvaluationPage:
    """A table of all trials, and the one that is picked in it.

    Raises ValueError for an evaluation without a finished trial, or a damaged file, naming it.
    """

    def __init__(self, page: Page, folder: Path):
        """Show the first trial; what is added to the folder while it is shown appears, too."""
        self._page, self._folder = page, folder
        self._rows = read_rows(folder)
        self._order: list[int] = []
        self._shown: int | None = None  # a row
        gui = page.server.gui
        self._title = gui.add_markdown("")
        self._rates = gui.add_html("")
        self._choice = gui.add_dropdown("Show", choices(self._rows))
        self._method = gui.add_dropdown("Method", (ALL, *methods_of(self._rows)))
        self._sort = gui.add_dropdown("Sort by", tuple(SORTS))
        self._descending = gui.add_checkbox("Descending", initial_value=False)
        self._pick = gui.add_slider("Trial", min=0, max=1, step=1, initial_value=0, hint="Keys: I and K")
        self._table = gui.add_html("")
        self._beside = gui.add_html("")
        self._overlaid = gui.add_checkbox(
            "Other methods", initial_value=True, hint="Their ropes in the same scene"
        )
        self._view = TrialView(page)
        self.player = self._view.player
        for control in (self._choice, self._method, self._sort, self._descending):
            control.on_update(page.calling(self._apply))
        self._pick.on_update(self._picked)
        self._overlaid.on_update(page.calling(lambda: self._load(again=True)))
        page.key("Previous trial", "I", lambda: self._step(-1))
        page.key("Next trial", "K", lambda: self._step(1))
        self._stopped = threading.Event()
        page.call(self._apply)
        threading.Thread(target=self._watch, name="trials", daemon=True).start()

    def close(self) -> None:
        """End what runs beside the page."""
        self._stopped.set()
        self._view.close()

    def go(self, wanted: Mapping[str, str]) -> None:
        """Go to where an address leads: a method's trial in a scene, and a state of it.

        Raises ValueError where there is no such trial.
        """
        if "scene" in wanted:
            found = [
                index
                for index, row in enumerate(self._rows)
                if str(row.line.trial) == wanted["scene"] and row.method == wanted.get("method", row.method)
            ]
            if not found:
                raise ValueError(f"there is no trial of {wanted.get('method', 'any method')} in scene "
                                 f"{wanted['scene']}")  # fmt: skip
            if found[0] not in self._order:
                self._choice.value, self._method.value = ALL, ALL
                self._apply()
            self._pick_place(self._order.index(found[0]))
        self._view.go(wanted)

    def _apply(self) -> None:
        """Filter and sort; the trial that is shown stays if it is still among them."""
        self._title.content = (
            f"**{len(self._rows):,} trials**, {len(methods_of(self._rows))} methods  \n"
            f"{plain(shortened(self._folder))}"
        )
        self._rates.content = rates(self._rows)
        self._order = chosen(
            self._rows,
            str(self._choice.value),
            str(self._method.value),
            str(self._sort.value),
            bool(self._descending.value),
        )
        self._pick.max = max(len(self._order) - 1, 1)
        self._pick.disabled = len(self._order) < 2
        if not self._order:
            self._table.content = "<div style='padding: 0 0.75em'>no trial passes the filter</div>"
            self._beside.content = ""
            return
        self._pick_place(self._order.index(self._shown) if self._shown in self._order else 0)

    def _pick_place(self, place: int) -> None:
        self._pick.value = place
        self._load()

    def _picked(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # by hand, not by `_pick_place`
            self._page.call(self._load)

    def _step(self, steps: int) -> None:
        if self._order:
            self._pick_place(int(np.clip(self._place + steps, 0, len(self._order) - 1)))

    @property
    def _place(self) -> int:
        return int(np.clip(self._pick.value, 0, max(len(self._order) - 1, 0)))

    def _load(self, again: bool = False) -> None:
        if not self._order:
            return
        index = self._order[self._place]
        self._table.content = table(self._rows, self._order, self._place, self._page.shown)
        self._beside.content = beside(self._rows, index, self._page.shown)
        if index == self._shown and not again:
            return
        row = self._rows[index]
        record = self._record(row.method, row.line.trial)
        others = {
            other.method: self._record(other.method, other.line.trial)
            for other in self._rows
            if other.line.trial == row.line.trial and other.method != row.method and self._overlaid.value
        }
        self._shown = index
        self._view.named = {"method": row.method, "scene": row.line.trial}
        name = f"scene {row.line.trial}, {row.method}"
        self._view.set(record, name, others, colours.method_colour(row.method))

    def _record(self, method: str, trial: int) -> TrialRecord:
        file = record_file(self._folder, method, trial)
        record = load_record(file)
        if not isinstance(record, TrialRecord):
            raise ValueError(f"{file} is no record of a trial")
        return record

    def _watch(self) -> None:
        """Look again and again whether trials have been added."""
        before = changes(self._folder)
        while not self._stopped.wait(LOOK_AGAIN):
            now = changes(self._folder)
            if now == before:
                continue
            try:
                rows = read_rows(self._folder)
            except (ValueError, OSError):  # being written: later
                continue
            before = now
            if rows != self._rows and not self._stopped.is_set():
                self._page.call(lambda rows=rows: self._renew(rows))

    def _renew(self, rows: list) -> None:
        if self._stopped.is_set():
            return
        shown = None if self._shown is None else self._rows[self._shown]
        self._rows = rows
        same = [i for i, row in enumerate(rows) if shown and row.method == shown.method
                and row.line.trial == shown.line.trial]  # fmt: skip
        self._shown = same[0] if same else None
        for control, options in ((self._choice, choices(rows)), (self._method, [ALL, *methods_of(rows)])):
            if list(control.options) != list(options):
                control.options = tuple(options)
        self._apply()


def changes(folder: Path) -> tuple[int, ...]:
    """What is another when an evaluation has got on."""
    return tuple(path.stat().st_mtime_ns for path in sorted([folder, *folder.glob("*/")]) if path.exists())
