"""A trial in the page: searches, plans, what was executed, what happened, and why it ended."""

import numpy as np

from doojax.experiments.trials.records import PlanRecord, TrialRecord
from doojax.viewer import colours
from doojax.viewer.films import film_of_trial
from doojax.viewer.page import Page
from doojax.viewer.player import Player
from doojax.viewer.plots import TimePlot
from doojax.viewer.show import plan_at, show_execution, show_plan, show_rope
from doojax.viewer.text import legend, listed, plain

FOLLOW = "the one being followed"
LEGEND = {"rope, executed": colours.EXECUTED, "recoveries": colours.RECOVERY, "gripper": colours.GRIPPER}
LEGEND |= {"goal": colours.GOAL, "chosen path": colours.CHOSEN, "obstacle": colours.OBSTACLE}
LEGEND |= {"tree, by depth or score": "viridis", "rejected": colours.REJECTED}


class TrialPage:
    """The controls and the scene of one trial."""

    def __init__(self, page: Page, record: TrialRecord, name: str):
        """Show the beginning of the trial."""
        self._page, self._record = page, record
        gui = page.server.gui
        ended = "reached the goal" if record.reached else "did not reach the goal"
        about = plain(f"{record.task.replace('_', ' ')} · {record.method} · seed {record.seed}")
        gui.add_markdown(f"**{about}**  \n{plain(name)}\n\n**{ended}**: {plain(record.end)}")
        self.player = Player(page, self._show)
        texts = [
            f"{i + 1}. state {event.step}: {event.kind} {event.text}" for i, event in enumerate(record.events)
        ]
        self._event = gui.add_dropdown("Event", ("(before)", *texts), hint="Keys: N next, P previous")
        self._facts = gui.add_markdown("")
        gui.add_html(legend(LEGEND))
        tabs = gui.add_tab_group()
        with tabs.add_tab("Search"):
            plans = [f"plan {i + 1}, at state {plan.step}" for i, plan in enumerate(record.plans)]
            self._plan = gui.add_dropdown("Plan", (FOLLOW, *plans))
            self._tree = gui.add_checkbox("Tree", initial_value=True)
            self._rejected = gui.add_checkbox(
                "Rejected", initial_value=True, hint="Extensions that were refused"
            )
            self._by = gui.add_dropdown("Colour by", ("depth", "score"))
            self._inspect = gui.add_checkbox("Show a node's rope", initial_value=False)
            self._node = gui.add_slider("Node", min=0, max=1, step=1, initial_value=0, visible=False)
            self._about_plan = gui.add_markdown("")
        with tabs.add_tab("Curves"):
            self._plot = TimePlot(gui, "distance to the goal, cm")
        if record.about:
            with tabs.add_tab("About"):
                gui.add_markdown(listed(record.about))
        self._drawn: tuple = ()
        self._event.on_update(page.calling(self._jump))
        for control in (self._plan, self._tree, self._rejected, self._by, self._inspect, self._node):
            control.on_update(page.calling(lambda: self._show(self.player.moment)))
        page.key("Next event", "N", lambda: self._go(1))
        page.key("Previous event", "P", lambda: self._go(-1))
        film = film_of_trial(record)
        film.set_up(page.drawing)
        page.stage(film.corners, film.floor, film.planar)
        page.call(self._start)

    def close(self) -> None:
        """End what runs beside the page."""
        self.player.stop()

    def _start(self) -> None:
        record = self._record
        distance = np.linalg.norm(record.goal_way - record.goal, axis=-1)
        self._plot.set({"distance": 100 * distance}, {"threshold": 100 * record.goal_radius})
        self.player.set_states(len(record.points))
        self._show(0.0)

    def _go(self, steps: int) -> None:
        options = self._event.options
        at = int(np.clip(options.index(self._event.value) + steps, 0, len(options) - 1))
        self._event.value = options[at]

    def _jump(self) -> None:
        at = self._event.options.index(self._event.value) - 1
        self.player.pause()
        self.player.go_to(float(self._record.events[at].step if at >= 0 else 0))

    def _show(self, moment: float) -> None:
        record = self._record
        show_execution(self._page.drawing, record, moment)
        self._plot.mark(moment)
        past = [event for event in record.events if event.step <= moment]
        distance = float(np.linalg.norm(record.goal_way[int(moment)] - record.goal))
        lines = [f"goal {100 * distance:.1f} cm away (reached within {100 * record.goal_radius:.0f} cm)"]
        lines += [f"last event: **{past[-1].kind}** {plain(past[-1].text)}"] if past else []
        self._facts.content = "  \n".join(lines)
        index = plan_at(record, int(moment))
        if self._plan.value != FOLLOW:
            index = self._plan.options.index(self._plan.value) - 1
        self._show_plan(index)

    def _show_plan(self, index: int | None) -> None:
        """Draw a plan where anything about it changed; a large tree is not sent again at every moment."""
        drawing = self._page.drawing
        wanted = (index, self._tree.value, self._rejected.value, self._by.value)
        if wanted != self._drawn:
            self._drawn = wanted
            if index is None:
                drawing.remove("plan")
                self._about_plan.content = "no plan yet"
            else:
                plan = self._record.plans[index]
                show_plan(
                    drawing,
                    plan,
                    self._record.look,
                    point=self._record.goal_point,
                    by=self._by.value,
                    rejected=self._rejected.value,
                    tree=self._tree.value,
                )
                self._about_plan.content = described(plan, index)
                self._node.max = max(len(plan.parent) - 1, 1)
                self._node.value = min(self._node.value, self._node.max)
        self._node.visible = self._inspect.value and index is not None
        if not self._inspect.value or index is None:
            drawing.remove("node")
            return
        plan, node = self._record.plans[index], int(self._node.value)
        colour = colours.CHOSEN if plan.accepted[node] else colours.REJECTED
        show_rope(
            drawing,
            "node",
            plan.points[node],
            plan.grippers[node],
            self._record.look,
            colour=colour,
            opacity=0.7,
        )


def described(plan: PlanRecord, index: int) -> str:
    """How a search went, as Markdown."""
    refused = int((~plan.accepted).sum())
    lines = [f"plan {index + 1}: {len(plan.parent):,} nodes, {refused:,} of them rejected"]
    lines.append(f"greatest depth {plan.depth().max(initial=0)}, path of {max(len(plan.path) - 1, 0)} steps")
    if plan.score is not None and np.isfinite(plan.score).any():
        lines.append(f"scores {np.nanmin(plan.score):.3g} to {np.nanmax(plan.score):.3g}")
    return "  \n".join(lines)
