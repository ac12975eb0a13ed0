"""A trial in the page: searches, plans, what was executed, what happened, and why it ended."""

from collections.abc import Mapping
from pathlib import Path

from doojax.experiments.trials.records import TrialRecord
from doojax.viewer.page import Page
from doojax.viewer.player import Player
from doojax.viewer.replan import Replanning, planned_by
from doojax.viewer.text import shortened
from doojax.viewer.trial_view import TrialView


class TrialPage:
    """The controls and the scene of one trial; of a plan, its goal may be dragged and planned to again."""

    def __init__(self, page: Page, record: TrialRecord, path: Path):
        """Show the beginning of the trial."""
        self._view = TrialView(page)
        if arguments := planned_by(record):
            with self._view.tabs.add_tab("Goal"):
                Replanning(page, record, path, arguments, self._set)
        page.call(lambda: self._set(record, path))

    @property
    def player(self) -> Player:
        """What moves through time."""
        return self._view.player

    def close(self) -> None:
        """End what runs beside the page."""
        self._view.close()

    def go(self, wanted: Mapping[str, str]) -> None:
        """Go to where an address leads."""
        self._view.go(wanted)

    def _set(self, record: TrialRecord, path: Path) -> None:
        self._view.set(record, shortened(path))
