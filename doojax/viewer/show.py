"""What is shown of episodes, predictions, plans and trials, on any `Drawing`: in the page and in pictures."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from doojax.experiments.drawing import Colour, Drawing
from doojax.experiments.trials.executed import Followed
from doojax.experiments.trials.records import (
    Look,
    PlanRecord,
    PredictionRecord,
    TrialRecord,
    body_of,
    solid_of,
)
from doojax.viewer import colours
from doojax.viewer.episodes import Episode
from doojax.viewer.robots import show_arms
from doojax.viewer.shapes import extended, smooth

EDGE_RADIUS = 0.006  # m, of a tree's edges where they start
WORST_ERROR = 0.10  # m: the red end of the colours of errors
FAR_DISTANCE = 0.15  # m: where the colours of signed distances fade out
DOT = 0.35  # of a voxel
GHOST = 0.75  # opacity


def gripper_radius(look: Look) -> float:
    """Grippers are drawn thicker than they are, lest the rope hides them; a hand that pushes is not."""
    if look.what == "body":
        return look.gripper_radius
    return 1.5 * max(look.gripper_radius, look.rope_radius)


def between(states: Float[np.ndarray, "T1 *k"], moment: float) -> Float[np.ndarray, "*k"]:
    """The state at a moment, linear between two states; before the first and after the last, those."""
    moment = min(max(moment, 0.0), len(states) - 1)
    before = int(moment)
    after = min(before + 1, len(states) - 1)
    part = moment - before
    return states[before] if part == 0 else (1 - part) * states[before] + part * states[after]


def show_rope(
    drawing: Drawing,
    name: str,
    points: Float[np.ndarray, "N 3"],
    grippers: Float[np.ndarray, "G 3"],
    look: Look,
    *,
    colour: Colour = colours.ROPE,
    opacity: float = 1.0,
) -> None:
    """A rope with its grippers; ``points`` are its links' centres. See `show_line` for what is none."""
    show_line(drawing, f"{name}/rope", points, grippers, look, colour=colour, opacity=opacity)
    if look.what == "container":
        return
    drawing.spheres(
        f"{name}/grippers", grippers, radius=gripper_radius(look), colours=colours.GRIPPER, opacity=opacity
    )


def show_line(
    drawing: Drawing,
    name: str,
    points: Float[np.ndarray, "N 3"],
    grippers: Float[np.ndarray, "G 3"],
    look: Look,
    *,
    colour: Colour,
    opacity: float = 1.0,
) -> None:
    """A rope without its grippers, a container's outline from rim to rim, or bodies as balls.

    Bodies are seen from above.
    """
    if look.what == "body":
        drawing.spheres(name, points, radius=look.rope_radius, colours=colour, opacity=opacity)
        return
    line, _ = solid_of(points, grippers, look)
    if look.what == "container":
        drawing.lines(name, segments_of(line), width=5.0, colours=colour)
    else:
        drawing.rope(
            name, extended(line, look.rope_end), radius=look.rope_radius, colour=colour, opacity=opacity
        )


def show_episode(
    drawing: Drawing, shown: Episode, moment: float, *, colour: Colour = colours.ROPE, trail: bool = False
) -> None:
    """The rope of an episode at a moment (in states), with what it left behind if ``trail``."""
    points, grippers = between(shown.points, moment), between(shown.grippers, moment)
    show_rope(drawing, "now", points, grippers, shown.look, colour=colour)
    if trail:
        show_trail(drawing, "trail", shown, int(moment))
    else:
        drawing.remove("trail")


def show_trail(drawing: Drawing, name: str, shown: Episode, until: int) -> None:
    """Up to a state, earlier ropes as thin lines, pale to dark, or ways of bodies; and of the grippers."""
    if shown.look.what == "body":
        show_ways(drawing, f"{name}/bodies", shown.points[: until + 1], colours.OBSTACLE)
    else:
        show_earlier(drawing, f"{name}/ropes", shown.points, until)
    show_ways(drawing, f"{name}/grippers", shown.grippers[: until + 1], colours.GRIPPER)


def show_earlier(drawing: Drawing, name: str, points: Float[np.ndarray, "T1 N 3"], until: int) -> None:
    """At most eight ropes before a state, pale to dark."""
    chosen = np.unique(np.linspace(0, until, 9).astype(int))[:-1]
    chosen = chosen[np.isfinite(points[chosen]).all((1, 2))]
    if not len(chosen):
        drawing.remove(name)
        return
    curves = [smooth(points[moment]) for moment in chosen]
    tint = colours.scale("time", 0.3 + 0.7 * chosen / max(len(points) - 1, 1))
    drawing.lines(
        name,
        np.concatenate([segments_of(curve) for curve in curves]),
        width=2.0,
        colours=np.repeat(tint, [len(curve) - 1 for curve in curves], axis=0),
    )


def show_ways(
    drawing: Drawing, name: str, places: Float[np.ndarray, "T1 K 3"], colour: Colour, width: float = 1.5
) -> None:
    """The ways of some balls as lines."""
    ways = np.stack([places[:-1], places[1:]], axis=2).reshape(-1, 2, 3)
    if len(ways):
        drawing.lines(name, ways, width=width, colours=colour)
    else:
        drawing.remove(name)


def segments_of(curve: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K-1 2 3"]:
    """The straight pieces of a polyline."""
    return np.stack([curve[:-1], curve[1:]], axis=1)


def show_prediction(drawing: Drawing, record: PredictionRecord, prediction: int, horizon: float) -> None:
    """What happened, and beside it what prediction ``prediction`` expected ``horizon`` steps after its start.

    The predicted rope is translucent; its points are coloured by their distance to the true ones, blue to red
    at `WORST_ERROR`.
    """
    look, moment = record.look, record.start[prediction] + horizon
    actual, grippers = between(record.points, moment), between(record.grippers, moment)
    show_rope(drawing, "actual", actual, grippers, look)
    points = between(record.predicted_points[prediction], horizon)
    hands = between(record.predicted_grippers[prediction], horizon)
    show_rope(drawing, "predicted", points, hands, look, colour=colours.PREDICTION, opacity=GHOST)
    if not np.isfinite(points).all() or moment > len(record.points) - 1:
        drawing.remove("predicted/errors")
        drawing.remove("predicted/misses")
        return
    error = np.linalg.norm(points - actual, axis=-1)
    tint = colours.scale("error", error / WORST_ERROR)
    drawing.spheres("predicted/errors", points, radius=1.2 * look.rope_radius, colours=tint)
    drawing.lines("predicted/misses", np.stack([actual, points], axis=1), width=1.5, colours=tint)


def show_grid(
    drawing: Drawing, record: PredictionRecord, prediction: int, layer: int | None, *, name: str = "input"
) -> None:
    """What the model saw, as dots: one horizontal layer of it, or all voxels that an obstacle fills.

    In a layer, blue is inside an obstacle; brown is near one, fading out with the distance from it.
    """
    drawing.remove(name)
    grid = record.grid
    if grid is None:
        return
    index = prediction if len(grid.values) > 1 else 0
    inside = grid.inside[index]
    away = grid.values[index] / FAR_DISTANCE if grid.kind == "distance" else 1 - grid.values[index]
    chosen = inside if layer is None else (away < 1) & (np.arange(inside.shape[2]) == layer)
    if not chosen.any():
        return
    places = grid.origin[index] + grid.spacing * np.argwhere(chosen)
    if layer is None:
        tint = colours.scale("viridis", colours.to_unit(places[:, 2]))
    else:
        tint = colours.scale("fading", away[chosen])
        tint[inside[chosen]] = colours.INSIDE
    drawing.points(name, places, size=DOT * grid.spacing, colours=tint)


def node_values(plan: PlanRecord, by: str) -> Float[np.ndarray, "n"]:
    """A tree's nodes' "depth" or "score", which their colours tell."""
    return plan.depth().astype(float) if by == "depth" or plan.score is None else plan.score


def node_colours(plan: PlanRecord, by: str) -> UInt8[np.ndarray, "n 3"]:
    """Colours of a tree's nodes by "depth" or "score", dark to light; rejected ones have their own."""
    accepted = np.where(plan.accepted, node_values(plan, by), np.nan)
    tint = colours.scale("viridis", colours.to_unit(accepted))
    return np.where(plan.accepted[:, None], tint, np.array(colours.REJECTED, dtype=np.uint8))


def show_plan(
    drawing: Drawing,
    plan: PlanRecord,
    look: Look,
    *,
    point: int,
    by: str = "depth",
    rejected: bool = True,
    tree: bool = True,
) -> None:
    """A search tree and the path that was chosen in it.

    Args:
        drawing: where to.
        plan: the search.
        look: sizes.
        point: the body at which a node is drawn: the rope's points are counted first, then the grippers.
        by: "depth" or "score", what the colours of accepted nodes say.
        rejected: whether extensions that were rejected are shown.
        tree: whether anything but the path is shown.
    """
    drawing.remove("plan")
    places = body_of(plan.points, plan.grippers, point)
    shown = np.flatnonzero((plan.accepted | rejected) & tree & (plan.parent >= 0))
    if len(shown):
        edges = np.stack([places[plan.parent[shown]], places[shown]], axis=1)
        drawing.cones("plan/tree", edges, radius=EDGE_RADIUS, colours=node_colours(plan, by)[shown])
    if len(plan.path):
        drawing.lines("plan/path", segments_of(places[plan.path]), width=5.0, colours=colours.CHOSEN)
        end = plan.points[plan.path[-1]], plan.grippers[plan.path[-1]]
        show_line(drawing, "plan/end", *end, look, colour=colours.CHOSEN, opacity=GHOST)


def show_execution(
    drawing: Drawing, record: TrialRecord, moment: float, colour: Colour = colours.EXECUTED
) -> None:
    """The executed rope at a moment, the goal, and the way so far of the point that is to reach it.

    Recoveries have a colour of their own in that way. Arms are shown where the record has their joints.
    """
    points, grippers = between(record.points, moment), between(record.grippers, moment)
    # a hand that an arm carries is seen well enough
    look = replace(record.look, gripper_radius=0.0) if "joints" in record.replay else record.look
    show_rope(drawing, "now", points, grippers, look, colour=colour)
    show_arms(drawing, record, moment)
    way = body_of(record.points, record.grippers, record.shown_point)[: int(moment) + 1]
    if len(way) < 2:
        drawing.remove("executed")
    else:
        tint = np.where(recovering(record)[: len(way) - 1, None], colours.RECOVERY, colour)
        drawing.lines("executed", segments_of(way), width=4.0, colours=tint.astype(np.uint8))
    if record.shown_point == record.goal_point:
        drawing.spheres(
            "goal", record.goal[None], radius=record.goal_radius, colours=colours.GOAL, opacity=0.6
        )


def show_expected(drawing: Drawing, record: TrialRecord, found: Followed, moment: float) -> None:
    """Where the plan that is being followed expects the rope at a moment; nothing where none does.

    Lines lead from where its points are to where they were expected.
    """
    state = min(int(moment), len(found.node) - 1)
    after = min(state + 1, len(found.node) - 1)
    plan, nodes = found.plan[after], [found.node[state], found.node[after]]
    if found.plan[state] != plan and plan >= 0 and found.node[after] >= 0:  # a new plan begins here
        nodes[0] = record.plans[plan].path[0]
    if moment == state:
        plan, nodes = found.plan[state], [found.node[state]] * 2
    if plan < 0 or min(nodes) < 0:
        drawing.remove("expected")
        return
    tree, look = record.plans[plan], record.look
    points = between(tree.points[nodes], moment - state)
    hands = between(tree.grippers[nodes], moment - state)
    show_line(drawing, "expected/rope", points, hands, look, colour=colours.PREDICTION, opacity=GHOST)
    actual, _ = solid_of(between(record.points, moment), between(record.grippers, moment), look)
    points, _ = solid_of(points, hands, look)
    drawing.lines(
        "expected/misses", np.stack([actual, points], axis=1), width=1.5, colours=colours.PREDICTION
    )


def recovering(record: TrialRecord) -> Bool[np.ndarray, "T"]:
    """Which steps of a trial were recoveries: those after such an event, until the next plan."""
    steps = np.zeros(len(record.points) - 1, dtype=bool)
    for event in record.events:
        steps[event.step :] = event.kind == "recover"
    return steps


def plan_at(record: TrialRecord, step: int) -> int | None:
    """Index of the plan that was being followed when state ``step`` was reached; None before the first."""
    made = [index for index, plan in enumerate(record.plans) if plan.step <= step]
    return made[-1] if made else None
