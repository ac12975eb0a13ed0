"""What a controller that samples tried: rollouts by their cost, the plan as a ghost, costs by term."""

from collections.abc import Callable

import numpy as np

from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.tried import costs_by_term, tried_in
from doojax.tasks.arms import BASE
from doojax.viewer import colours
from doojax.viewer.page import Page
from doojax.viewer.plots import TimePlot
from doojax.viewer.robots import ends_of, robot_of, show_robot
from doojax.viewer.show import segments_of
from doojax.viewer.text import legend

PARTS = ("tried", "planned")
GHOST = 0.3  # opacity


class ControlView:
    """The controls of what was tried; in a folder of the page that is empty where nothing was."""

    def __init__(self, page: Page, again: Callable[[], None]):
        """Add the controls to the page's current folder; ``again`` has the present moment shown anew."""
        gui = page.server.gui
        self._page = page
        self._about = gui.add_markdown("no control by sampling was recorded")
        self._rollouts = gui.add_checkbox("Rollouts", initial_value=True, visible=False)
        self._ghost = gui.add_checkbox("Planned motion", initial_value=True, visible=False)
        self._legend = gui.add_html("")
        self._costs = TimePlot(gui, "cost by term, mean of the samples")
        for control in (self._rollouts, self._ghost):
            control.on_update(page.calling(again))

    def set(self, record: TrialRecord) -> None:
        """Of another trial. Raises ValueError for a record whose arrays do not fit together."""
        for part in PARTS:
            self._page.drawing.remove(part)
        self._record, self._tried, self._robot = record, tried_in(record), robot_of(record)
        terms = costs_by_term(record)
        there = self._tried is not None
        self._rollouts.visible = self._ghost.visible = there
        self._costs.set(terms)
        self._about.content = "" if there or terms else "no control by sampling was recorded"

    def show(self, moment: float) -> None:
        """What was tried in the state before a moment; nothing after the last command."""
        command, drawing = int(moment), self._page.drawing
        self._costs.mark(float(min(command, len(self._record.points) - 1)))
        tried = self._tried
        known = tried is not None and command < len(tried.tried)
        if tried is None or not known or not self._rollouts.value:
            drawing.remove("tried")
        if tried is None or not known or not self._ghost.value:
            drawing.remove("planned")
        if tried is None or not known:
            self._legend.content = ""
            return
        here = self._record.goal_way[command]
        cost = tried.tried_cost[command]
        priced = np.isfinite(cost)
        low, high = (cost[priced].min(), cost[priced].max()) if priced.any() else (np.nan, np.nan)
        self._legend.content = legend(
            {
                f"{priced.sum()} samples by rank, cost {low:.3g} to {high:.3g}": "error",
                "plan": colours.PREDICTION,
            }
        )
        if self._rollouts.value:
            ways = tried.tried[command][priced][::-1]  # the best are drawn last
            lines = [segments_of(np.concatenate([here[None], way])) for way in ways]
            # by rank: of costs, a single one that is high would leave all others alike
            tint = colours.scale("error", np.linspace(1, 0, len(ways)))
            if lines:
                drawing.lines(
                    "tried", np.concatenate(lines), width=1.5, colours=np.repeat(tint, len(lines[0]), axis=0)
                )
        if self._ghost.value:
            self._show_plan(command, here)

    def _show_plan(self, command: int, here: np.ndarray) -> None:
        """The arms at the end of the plan, translucent, and the ways of tool and cable's end there."""
        tried, drawing = self._tried, self._page.drawing
        if tried is None:
            return
        ways = [np.concatenate([here[None], tried.planned[command]]), tried.planned_tool[command]]
        drawing.lines(
            "planned/ways",
            np.concatenate([segments_of(way) for way in ways]),
            width=4.0,
            colours=colours.PREDICTION,
        )
        if self._robot is not None:
            ends = ends_of(self._robot, tried.planned_joints[command, -1])
            show_robot(
                drawing,
                "planned/arms",
                self._robot,
                ends,
                base=BASE,
                colour=colours.PREDICTION,
                opacity=GHOST,
            )
