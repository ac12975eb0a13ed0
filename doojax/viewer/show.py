"""What is shown of episodes, predictions, plans and trials, on any `Drawing`: in the page and in pictures."""

import numpy as np
from jaxtyping import Float, UInt8

from doojax.experiments.drawing import Colour, Drawing
from doojax.experiments.records import Look, PlanRecord, PredictionRecord, TrialRecord
from doojax.viewer import colours
from doojax.viewer.episodes import Episode
from doojax.viewer.shapes import extended, smooth

NODE_SIZE = 0.012  # m
WORST_ERROR = 0.10  # m: the red end of the colours of errors
FAR_DISTANCE = 0.25  # m: where the colours of signed distances end
GHOST = 0.55  # opacity


def gripper_radius(look: Look) -> float:
    """Grippers are drawn a little thicker than they are, lest the rope hides them."""
    return 1.25 * max(look.gripper_radius, look.rope_radius)


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
    """A rope with its grippers; ``points`` are its links' centres."""
    curve = extended(points, look.rope_end)
    drawing.rope(f"{name}/rope", curve, radius=look.rope_radius, colour=colour, opacity=opacity)
    drawing.spheres(
        f"{name}/grippers", grippers, radius=gripper_radius(look), colours=colours.GRIPPER, opacity=opacity
    )


def show_episode(
    drawing: Drawing, shown: Episode, moment: float, *, colour: Colour = colours.ROPE, trail: bool = False
) -> None:
    """The rope of an episode at a moment (in states), with what it left behind if ``trail``."""
    points, grippers = between(shown.points, moment), between(shown.grippers, moment)
    show_rope(drawing, "now", points, grippers, shown.look, colour=colour)
    if trail:
        show_trail(drawing, "trail", shown.points, shown.grippers, int(moment))
    else:
        drawing.remove("trail")


def show_trail(
    drawing: Drawing,
    name: str,
    points: Float[np.ndarray, "T1 N 3"],
    grippers: Float[np.ndarray, "T1 G 3"],
    until: int,
) -> None:
    """Earlier ropes as thin lines, pale to dark, and the grippers' ways, up to a state."""
    chosen = np.unique(np.linspace(0, until, 9).astype(int))[:-1]
    chosen = chosen[np.isfinite(points[chosen]).all((1, 2))]
    drawing.remove(f"{name}/ropes")
    if len(chosen):
        curves = [smooth(points[moment]) for moment in chosen]
        tint = colours.scale("time", 0.3 + 0.7 * chosen / max(len(points) - 1, 1))
        drawing.lines(
            f"{name}/ropes",
            np.concatenate([segments_of(curve) for curve in curves]),
            width=2,
            colours=np.repeat(tint, [len(curve) - 1 for curve in curves], axis=0),
        )
    ways = np.stack([grippers[:until], grippers[1 : until + 1]], axis=2).reshape(-1, 2, 3)
    drawing.remove(f"{name}/grippers")
    if len(ways):
        drawing.lines(f"{name}/grippers", ways, width=1.5, colours=colours.GRIPPER)


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
    drawing.remove("predicted/errors")
    drawing.remove("predicted/misses")
    if not np.isfinite(points).all() or moment > len(record.points) - 1:
        return
    error = np.linalg.norm(points - actual, axis=-1)
    tint = colours.scale("error", error / WORST_ERROR)
    drawing.spheres("predicted/errors", points, radius=1.35 * look.rope_radius, colours=tint)
    drawing.lines("predicted/misses", np.stack([actual, points], axis=1), width=1.5, colours=tint)


def show_grid_slice(drawing: Drawing, record: PredictionRecord, prediction: int, height: float) -> None:
    """The horizontal slice of what the model saw nearest to ``height`` (m): blue inside, brown far off."""
    drawing.remove("slice")
    grid = record.grid
    if grid is None:
        return
    index = prediction if len(grid.values) > 1 else 0
    values, origin = grid.values[index], grid.origin[index]
    layer = int(np.clip(round((height - origin[2]) / grid.spacing), 0, values.shape[2] - 1))
    x, y = np.meshgrid(np.arange(values.shape[0]), np.arange(values.shape[1]), indexing="ij")
    places = origin + grid.spacing * np.stack([x, y, np.full_like(x, layer)], axis=-1)
    flat = values[:, :, layer]
    tint = colours.scale("signed", 0.5 + np.clip(flat / FAR_DISTANCE, -1, 1) / 2)
    drawing.points("slice", places.reshape(-1, 3), size=0.9 * grid.spacing, colours=tint.reshape(-1, 3))


def node_places(plan: PlanRecord, point: int) -> Float[np.ndarray, "n 3"]:
    """Where each node of a search tree is drawn: at one point of its rope."""
    return plan.points[:, point]


def node_colours(plan: PlanRecord, by: str) -> UInt8[np.ndarray, "n 3"]:
    """Colours of a tree's nodes by "depth" or "score", dark to light; rejected ones have their own."""
    values = plan.depth().astype(float) if by == "depth" or plan.score is None else plan.score
    accepted = np.where(plan.accepted, values, np.nan)
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
        point: the rope's point at which a node is drawn.
        by: "depth" or "score", what the colours of accepted nodes say.
        rejected: whether extensions that were rejected are shown.
        tree: whether anything but the path is shown.
    """
    drawing.remove("plan")
    places = node_places(plan, point)
    shown = (plan.accepted | rejected) & tree
    if shown.any():
        tint = node_colours(plan, by)
        drawing.points("plan/nodes", places[shown], size=NODE_SIZE, colours=tint[shown])
        child = np.flatnonzero(shown & (plan.parent >= 0))
        edges = np.stack([places[plan.parent[child]], places[child]], axis=1)
        drawing.lines("plan/edges", edges, width=1.0, colours=tint[child])
    if len(plan.path):
        drawing.lines("plan/path", segments_of(places[plan.path]), width=5, colours=colours.CHOSEN)
        last = plan.path[-1]
        curve = extended(plan.points[last], look.rope_end)
        drawing.rope("plan/end", curve, radius=look.rope_radius, colour=colours.CHOSEN, opacity=GHOST)


def show_execution(drawing: Drawing, record: TrialRecord, moment: float) -> None:
    """The executed rope at a moment, the way so far of the point that is to reach the goal, and the goal."""
    points, grippers = between(record.points, moment), between(record.grippers, moment)
    show_rope(drawing, "now", points, grippers, record.look)
    drawing.remove("executed")
    way = record.points[: int(moment) + 1, record.goal_point]
    if len(way) > 1:
        drawing.lines("executed", segments_of(way), width=4, colours=colours.EXECUTED)
    drawing.spheres("goal", record.goal[None], radius=record.goal_radius, colours=colours.GOAL, opacity=0.45)


def plan_at(record: TrialRecord, step: int) -> int | None:
    """Index of the plan that was being followed when state ``step`` was reached; None before the first."""
    made = [index for index, plan in enumerate(record.plans) if plan.step <= step]
    return made[-1] if made else None
