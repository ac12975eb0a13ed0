"""Dragging the goal of a plan in the page, and planning again."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import viser
from jaxtyping import Float

from doojax.commands import parsed
from doojax.experiments.trials.plan import free_name, plan
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.records import TrialRecord
from doojax.viewer.episodes import episode_of
from doojax.viewer.page import Page


def planned_by(record: TrialRecord) -> dict[str, Any] | None:
    """With what `doojax plan` made a record, if it did and the goal is one place; else None."""
    try:
        ((function, arguments),) = parsed(str(record.about.get("command", "")))
    except ValueError:
        return None
    return arguments if function is plan and not record.about.get("more_targets") else None


class Replanning:
    """A goal that can be dragged, and a button that plans to where it is."""

    def __init__(
        self,
        page: Page,
        record: TrialRecord,
        path: Path,
        arguments: dict[str, Any],
        show: Callable[[TrialRecord, Path], None],
    ):
        """Add the controls to the page's current folder.

        Args:
            page: where to.
            record: the plan.
            path: its file; new records go beside it.
            arguments: of `doojax plan`, by which it was made.
            show: is given each new record and its file.
        """
        self._page, self._path, self._arguments, self._show = page, path, arguments, show
        gui, goal = page.server.gui, triple(record.goal)
        gui.add_markdown("Drag the goal by its arrows, or type where it is to be (m).")
        self._place = gui.add_vector3("Goal", goal, step=0.01)
        self._button = gui.add_button("Plan again", icon=viser.Icon.ROUTE)
        flat = episode_of(record).planar
        self._handle = page.server.scene.add_transform_controls(
            "/goal handle",
            scale=4 * record.goal_radius,
            disable_rotations=True,
            active_axes=(True, True, not flat),
            position=goal,
            depth_test=False,
        )
        self._handle.on_update(page.calling(self._dragged))
        self._place.on_update(page.calling(self._typed))
        self._button.on_click(self._again)

    def _dragged(self) -> None:
        self._place.value = triple(np.round(self._handle.position, 3))

    def _typed(self) -> None:
        if not np.allclose(self._handle.position, self._place.value, atol=2e-3):
            self._handle.position = self._place.value

    def _again(self, _: object) -> None:
        """Plan, without the page's lock: it lives on meanwhile."""
        self._button.disabled, self._button.label = True, "Planning …"
        try:
            out = free_name(self._path)
            arguments = {**self._arguments, "goal": triple(self._place.value), "out": out}
            plan(arguments.pop("task"), **arguments)
            record = load_record(out)
        except (ValueError, OSError) as error:
            self._page.report(error)
        else:
            if isinstance(record, TrialRecord):
                self._page.quiet()
                self._page.call(lambda: self._show(record, out))
        finally:
            self._button.disabled, self._button.label = False, "Plan again"


def triple(place: Sequence[float] | Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    """A place as viser and the command line take it."""
    x, y, z = (float(value) for value in place)
    return x, y, z
