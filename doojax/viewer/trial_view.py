"""One trial, moment by moment: searches, what plans expected beside what was executed, why it ended."""

import re
from collections.abc import Mapping

import numpy as np
import viser
from jaxtyping import Float

from doojax.experiments.drawing import Colour, Drawing
from doojax.experiments.trials.executed import followed
from doojax.experiments.trials.judges import EXPECTED, name_of_score, score_said
from doojax.experiments.trials.records import PlanRecord, TrialRecord
from doojax.experiments.trials.touching import obstacle_names
from doojax.experiments.trials.trial_list import KEEP
from doojax.experiments.trials.volumes import said_of, volumes_of
from doojax.experiments.trials.why import SEARCHED, why
from doojax.types import Obstacles
from doojax.viewer import colours
from doojax.viewer.control_view import ControlView
from doojax.viewer.draw import Anchor
from doojax.viewer.episodes import episode_of
from doojax.viewer.films import Film, corners_of_trial, film_of_trial
from doojax.viewer.page import Page
from doojax.viewer.player import Player
from doojax.viewer.plots import TimePlot
from doojax.viewer.pouring import Flow, film_of_pour, per_state, simulated_again
from doojax.viewer.show import (
    between,
    node_values,
    plan_at,
    recovering,
    show_execution,
    show_expected,
    show_plan,
    show_rope,
)
from doojax.viewer.sight import Sight
from doojax.viewer.text import legend, listed, plain

FOLLOW: str = "the one being followed"
BEFORE: str = "(before)"
SEE_THROUGH = 0.55  # opacity of obstacles, lest a path vanish in one
SAME = {"gripper": colours.GRIPPER, "goal": colours.GOAL, "chosen path": colours.CHOSEN}
PARTS = ("now", "arms", "executed", "expected", "others", "plan", "node", "goal", "goal label", "names")
PARTS += ("obstacles", "flow")
NUMBERED = re.compile(r"\b(?:box|cylinder|capsule|table) (\d+)\b")


class TrialView:
    """The controls and the scene of one trial at a time: `set` says of which."""

    def __init__(self, page: Page):
        """Add the controls to the page's current folder; nothing is shown yet."""
        self._page = page
        gui = page.server.gui
        self._record: TrialRecord | None = None
        self._others: dict[str, TrialRecord] = {}
        self.named: dict[str, object] = {}  # what an address must say to lead to this trial
        self._heading = gui.add_markdown("")
        self.player = Player(page, self._show)
        self._event = gui.add_dropdown("Event", (BEFORE,), hint="Keys: N next, P previous")
        self._facts = gui.add_markdown("")
        self._legend = gui.add_html("")
        self.tabs = gui.add_tab_group()
        with self.tabs.add_tab("Curves"):
            self._error = TimePlot(gui, "error of the plan, cm (RMS over the rope's points)")
            self._score = TimePlot(gui, "score of the step")
            self._distance = TimePlot(gui, "distance to the goal, cm")
        with self.tabs.add_tab("Search"):
            self._plan = gui.add_dropdown("Plan", (FOLLOW,))
            self._tree = gui.add_checkbox("Tree", initial_value=True)
            self._rejected = gui.add_checkbox("Rejected", initial_value=True, hint="Refused extensions")
            self._by = gui.add_dropdown("Colour by", ("depth", "score"))
            self._inspect = gui.add_checkbox("Show a node's rope", initial_value=False)
            self._node = gui.add_slider("Node", min=0, max=1, step=1, initial_value=0, visible=False)
            self._about_plan = gui.add_markdown("")
        with self.tabs.add_tab("Control"):
            self._control = ControlView(page, lambda: self._show(self.player.moment))
        with self.tabs.add_tab("View"):
            self.sight = Sight(page, self._obstacles, self._film, self.place, opacity=SEE_THROUGH)
            self._numbers = gui.add_checkbox("Numbers", initial_value=False, hint="Of all obstacles")
        with self.tabs.add_tab("About"):
            self._about = gui.add_markdown("")
        self._drawn: tuple = ()
        self._flow: Flow | None = None  # of a container: what its fluid did
        self._event.on_update(self._event_chosen)
        for control in (self._plan, self._tree, self._rejected, self._by, self._inspect, self._node):
            control.on_update(page.calling(lambda: self._show(self.player.moment)))
        self._numbers.on_update(page.calling(self._number))
        page.key("Next event", "N", lambda: self._go(1))
        page.key("Previous event", "P", lambda: self._go(-1))

    def close(self) -> None:
        """End what runs beside the page."""
        self.player.stop()

    def place(self) -> dict[str, object]:
        """What an address must say to lead to this moment."""
        return {**self.named, "state": int(self.player.moment)}

    def go(self, wanted: Mapping[str, str]) -> None:
        """Go to where an address leads. Raises ValueError for a state that is no number."""
        if "state" in wanted:
            self.player.pause()
            self.player.go_to(float(wanted["state"]))

    def set(
        self,
        record: TrialRecord,
        name: str,
        others: Mapping[str, TrialRecord] | None = None,
        colour: Colour = colours.EXECUTED,
    ) -> None:
        """Show another trial.

        Args:
            record: of the trial.
            name: what it is called in the page.
            others: trials of other methods in the same scene, whose ropes are shown beside, by method.
            colour: of the executed rope.
        """
        drawing = self._page.drawing
        for part in PARTS:
            drawing.remove(part)
        first = self._record is None
        self._flow = simulated_again(record)[0] if record.look.what == "container" else None
        self._record, self._others, self._colour = record, dict(others or {}), colour
        self._found = followed(record)
        self._drawn = ()
        ended = "reached the goal" if record.reached else "did not reach the goal"
        about = plain(f"{record.task.replace('_', ' ')} · {record.method} · seed {record.seed}")
        self._heading.content = (
            f"**{about}**  \n{plain(name)}\n\n**{ended}**: {plain(record.end)}\n\nwhy: {plain(why(record))}"
        )
        self._set_options()
        self._set_curves()
        self._control.set(record)
        self._about.content = listed({key: value for key, value in record.about.items() if key != "why"})
        if first:  # later ones are seen from where somebody has turned the view to
            self._page.stage(corners_of_trial(record), record.look.floor, episode_of(record).planar)
        if self._flow is None:
            drawing.text("goal label", "goal", record.goal + np.array([0, 0, 1.2 * record.goal_radius]))
        self.sight.draw()
        self._number()
        self.player.set_states(max(len(one.points) for one in (record, *self._others.values())))
        self.player.go_to(0.0)

    def _set_options(self) -> None:
        record = self._of()
        texts = [
            f"{i + 1}. state {event.step}: {event.kind} {event.text}" for i, event in enumerate(record.events)
        ]
        plans = [f"plan {i + 1}, at state {plan.step}" for i, plan in enumerate(record.plans)]
        for dropdown, options in ((self._event, (BEFORE, *texts)), (self._plan, (FOLLOW, *plans))):
            dropdown.options = options
            dropdown.value = options[0]

    def _set_curves(self) -> None:
        record, found = self._of(), self._found
        searches = [plan.step for plan in record.plans]
        recoveries = (np.flatnonzero(recovering(record)) + 1).tolist()
        marks = {name: states for name, states in (("search", searches), ("recovery", recoveries)) if states}
        distance = 100 * np.linalg.norm(record.goal_way - record.goal, axis=-1)
        self._distance.set({"distance": distance}, {"threshold": 100 * record.goal_radius}, marks)
        bound = record.about.get("error_threshold_m")
        self._error.set(
            {"error": 100 * found.error}, {} if bound is None else {"threshold": 100 * bound}, marks
        )
        name, level = name_of_score(record.method), record.about.get("score_threshold")
        levels = {} if level is None else {"threshold": float(level)}
        known, lucky = np.isfinite(found.score), np.zeros(len(found.score), dtype=bool)
        if level is not None and name != EXPECTED:  # whose scores are to be low
            lucky = known & (found.score < level)
        judged = {"accepted": known & ~lucky, "accepted by luck": lucky}
        states = {kind: np.flatnonzero(which).tolist() for kind, which in judged.items() if which.any()}
        self._score.set({name: found.score}, levels, states)

    def _of(self) -> TrialRecord:
        if self._record is None:
            raise ValueError("no trial is shown yet")
        return self._record

    def _obstacles(self) -> list[tuple[Drawing, Obstacles]]:
        return [(self._page.drawing, self._of().obstacles)]

    def _film(self) -> Film:
        record = self._of()
        return film_of_trial(record) if self._flow is None else film_of_pour(record)

    def _number(self) -> None:
        """Write the names of the obstacles that the sentence speaks of beside them, or those of all."""
        record, drawing = self._of(), self._page.drawing
        active, centre = np.asarray(record.obstacles.active), np.asarray(record.obstacles.centre)
        said = {int(number) for number in NUMBERED.findall(why(record))}
        drawing.remove("names")
        names = obstacle_names(record.obstacles)
        numbers = [n for n in range(len(names)) if active[n] and (self._numbers.value or n in said)]
        anchors = apart(centre[numbers])
        for number, anchor in zip(numbers, anchors, strict=True):
            top = centre[number] + np.array([0, 0, float(record.obstacles.half_size[number, 2])])
            drawing.text(f"names/{number}", names[number], top, anchor)

    def _event_chosen(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # by hand: it follows the state, too
            self._page.call(self._jump)

    def _go(self, steps: int) -> None:
        options = self._event.options
        at = int(np.clip(options.index(self._event.value) + steps, 0, len(options) - 1))
        self._jump(at)

    def _jump(self, at: int | None = None) -> None:
        at = self._event.options.index(self._event.value) if at is None else at
        self.player.pause()
        self.player.go_to(float(self._of().events[at - 1].step if at > 0 else 0))
        self._event.value = self._event.options[at]  # of several at one state, the one that was meant

    def _show(self, moment: float) -> None:
        record, drawing = self._of(), self._page.drawing
        show_execution(drawing, record, moment, self._colour)
        for method, other in self._others.items():
            points, hands = between(other.points, moment), between(other.grippers, moment)
            shown = colours.method_colour(method)
            show_rope(drawing, f"others/{method}", points, hands, other.look, colour=shown)
        if self._flow is not None:
            self._flow.show(drawing, moment * per_state(self._flow.scene))
        show_expected(drawing, record, self._found, moment)
        self._control.show(moment)
        for plot in (self._error, self._score, self._distance):
            plot.mark(min(moment, len(record.points) - 1))
        past = [number for number, event in enumerate(record.events) if event.step <= moment]
        current = self._event.options[past[-1] + 1 if past else 0]
        if self._event.value != current:
            self._event.value = current
        state = min(int(moment), len(record.points) - 1)
        self._facts.content = "  \n".join(self._said(state))
        index = plan_at(record, state)
        if self._plan.value != FOLLOW:
            index = self._plan.options.index(self._plan.value) - 1
        self._show_plan(index)

    def _said(self, state: int) -> list[str]:
        record, found = self._of(), self._found
        distance = float(np.linalg.norm(record.goal_way[state] - record.goal))
        lines = [f"goal {100 * distance:.1f} cm away (reached within {100 * record.goal_radius:.0f} cm)"]
        if self._flow is not None:
            lines = [said_of(*volumes_of(record)[state])]
        if found.node[state] >= 0:
            plan = int(found.plan[state])
            step, last = state - record.plans[plan].step, len(record.plans[plan].path) - 1
            off = f"{100 * found.error[state]:.1f} cm off what it expected"
            lines.append(f"plan {plan + 1}, step {step} of {last}: {off}")
            said = score_said(record.method, float(found.score[state]))
            lines += [said] if said else []
        past = [event for event in record.events if event.step <= state]
        lines += [f"last event: **{past[-1].kind}** {plain(past[-1].text)}"] if past else []
        return lines

    def _show_plan(self, index: int | None) -> None:
        """Draw a plan where anything about it changed; a large tree is not sent again at every moment."""
        drawing, record = self._page.drawing, self._of()
        wanted = (index, self._tree.value, self._rejected.value, self._by.value)
        if wanted != self._drawn:
            self._drawn = wanted
            self._legend.content = legend(self._meanings(index))
            if index is None:
                drawing.remove("plan")
                self._about_plan.content = "no plan yet"
            else:
                plan = record.plans[index]
                show_plan(
                    drawing,
                    plan,
                    record.look,
                    point=record.shown_point,
                    by=self._by.value,
                    rejected=self._rejected.value,
                    tree=self._tree.value,
                )
                self._about_plan.content = described(plan, index, extensions_of(record, index))
                self._node.max = max(len(plan.parent) - 1, 1)
                self._node.value = min(self._node.value, self._node.max)
        self._node.visible = self._inspect.value and index is not None
        if not self._inspect.value or index is None:
            drawing.remove("node")
            return
        plan, node = record.plans[index], int(self._node.value)
        colour = colours.CHOSEN if plan.accepted[node] else colours.REJECTED
        show_rope(
            drawing, "node", plan.points[node], plan.grippers[node], record.look, colour=colour, opacity=0.7
        )

    def _meanings(self, index: int | None) -> dict[str, Colour | str]:
        """What colours mean, with the numbers at the ends of the tree's."""
        record = self._of()
        what = record.look.what
        executed = {f"{what}, executed": self._colour, "as planned": colours.PREDICTION}
        meanings: dict[str, Colour | str] = dict(executed)
        meanings |= {name: colours.method_colour(name) for name in self._others}
        meanings |= {name: SAME[name] for name in SAME if what != "container" or name == "chosen path"}
        meanings |= {"obstacle": colours.OBSTACLE}
        if recovering(record).any():
            meanings["recoveries"] = colours.RECOVERY
        if index is None or not kept(record.plans[index], extensions_of(record, index)):
            return meanings
        plan, by = record.plans[index], str(self._by.value)
        values = node_values(plan, by)[plan.accepted]
        values = values[np.isfinite(values)]
        bounds = f", {values.min():.3g} to {values.max():.3g}" if len(values) else ""
        return meanings | {f"tree, by {by}{bounds}": "viridis", "rejected": colours.REJECTED}


def apart(places: Float[np.ndarray, "k 3"]) -> list[Anchor]:
    """Which corner of its words is at each place, so that they lead away from those at the others."""
    if not len(places):
        return []
    left, far = ((places[:, :2] - places[:, :2].mean(0)) * [-1, 1] > 1e-6).T
    corners: dict[tuple[bool, bool], Anchor] = {
        (False, False): "top-left",
        (True, False): "top-right",
        (False, True): "bottom-left",
        (True, True): "bottom-right",
    }
    return [corners[bool(to_left), bool(behind)] for to_left, behind in zip(left, far, strict=True)]


def extensions_of(record: TrialRecord, index: int) -> int | None:
    """How many extensions a search tried, as its event says; None where none says it."""
    said = [SEARCHED.match(event.text) for event in record.events if event.kind == "plan"]
    found = said[index] if index < len(said) else None
    return int(found[4]) if found else None


def kept(plan: PlanRecord, extensions: int | None) -> bool:
    """Was all that a search tried recorded, or only the nodes of its plan?"""
    return len(plan.parent) > len(plan.path) or (extensions or 0) < len(plan.parent)


def described(plan: PlanRecord, index: int, extensions: int | None) -> str:
    """How a search went, as Markdown."""
    steps = max(len(plan.path) - 1, 0)
    if not kept(plan, extensions):
        return f"plan {index + 1}: path of {steps} steps  \n{plain(KEEP)}"
    refused = int((~plan.accepted).sum())
    lines = [f"plan {index + 1}: {len(plan.parent):,} nodes, {refused:,} of them rejected"]
    lines.append(f"greatest depth {plan.depth().max(initial=0)}, path of {steps} steps")
    if plan.score is not None and np.isfinite(plan.score).any():
        lines.append(f"scores {np.nanmin(plan.score):.3g} to {np.nanmax(plan.score):.3g}")
    return "  \n".join(lines)
