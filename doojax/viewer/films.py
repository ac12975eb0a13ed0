"""What can be shown moment by moment on any `Drawing`, without controls: for pictures and recordings."""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doojax.datasets import Dataset
from doojax.experiments.drawing import Drawing
from doojax.experiments.trials.records import PredictionRecord, TrialRecord, body_of
from doojax.geometry.segment_sdf import segment_signed_distance
from doojax.types import Obstacles
from doojax.viewer import colours
from doojax.viewer.episodes import episode, episode_of, title
from doojax.viewer.robots import corners_of_arms
from doojax.viewer.show import plan_at, show_episode, show_execution, show_plan, show_prediction

FROM_SIDE = np.array([0.80, -0.50, 0.48]) / np.linalg.norm([0.80, -0.50, 0.48])
OTHER_SIDE = FROM_SIDE * np.array([-1.0, 1.0, 1.0])
SIGHT = 3.0  # m, of the lines along which something may stand in the way


@dataclass(frozen=True)
class Film:
    """``states`` moments of something: ``set_up`` draws what stands still, ``show`` the rest at a moment."""

    title: str
    corners: Float[np.ndarray, "K 3"]  # points around which a picture must reach, metres
    floor: float | None  # its height, metres
    planar: bool  # does everything move at one height? Then it is best seen from above
    states: int
    period: float  # s between two states
    set_up: Callable[[Drawing], None]
    show: Callable[[Drawing, float], None]
    seen_from: Float[np.ndarray, "3"] = field(default_factory=lambda: FROM_SIDE)  # where it is not planar


def clear_side(points: Float[np.ndarray, "K 3"], obstacles: Obstacles) -> Float[np.ndarray, "3"]:
    """From which of two sides more of some points is seen past the obstacles; the usual one of equals."""
    if not obstacles.kind.shape[0]:
        return FROM_SIDE
    hidden = []
    for side in (FROM_SIDE, OTHER_SIDE):
        begin = jnp.asarray(points, jnp.float32)
        ways = segment_signed_distance(obstacles, begin, begin + SIGHT * jnp.asarray(side, jnp.float32))
        hidden.append(float((ways < 0).mean()))
    return OTHER_SIDE if hidden[1] < hidden[0] else FROM_SIDE


def film_of_trajectory(dataset: Dataset, index: int) -> Film:
    """A trajectory of a data set, with what it left behind.

    Raises:
        IndexError: outside of the data set.
        ValueError: for a damaged chunk file, naming it.
    """
    shown = episode(dataset, index)
    return Film(
        title=f"{title(dataset)}   #{dataset.rows[index]}",
        corners=shown.corners(),
        floor=shown.look.floor,
        planar=shown.planar,
        states=len(shown.points),
        period=shown.period,
        set_up=lambda drawing: drawing.obstacles("obstacles", shown.obstacles, colour=colours.OBSTACLE),
        show=lambda drawing, moment: show_episode(drawing, shown, moment, trail=True),
    )


def film_of_prediction(record: PredictionRecord, index: int) -> Film:
    """One prediction beside what happened.

    Raises:
        IndexError: outside of the record.
    """
    count = len(record.start)
    if not 0 <= index < count:
        raise IndexError(f"there is no prediction {index}: the record holds {count}, counted from 0")
    trajectory = record.trajectory(index)
    world = episode_of(record, trajectory)
    predicted = record.predicted_points[index]
    known = np.isfinite(predicted).all((1, 2))
    return Film(
        title=f"{record.task.replace('_', ' ')} · prediction {index}",
        corners=np.concatenate([world.corners(), predicted[known].reshape(-1, 3)]),
        floor=record.look.floor,
        planar=world.planar,
        states=int(np.flatnonzero(known).max(initial=0)) + 1,
        period=record.period,
        set_up=lambda drawing: drawing.obstacles(
            "obstacles", record.obstacles_of(trajectory), colour=colours.OBSTACLE
        ),
        show=lambda drawing, moment: show_prediction(drawing, record, index, moment),
    )


def corners_of_trial(record: TrialRecord) -> Float[np.ndarray, "K 3"]:
    """Points (m) around which a picture of a trial must reach: what there is, and all that was tried."""
    nodes = [body_of(plan.points, plan.grippers, record.shown_point) for plan in record.plans]
    goal = record.goal[None][: record.shown_point == record.goal_point]
    everything = [episode_of(record).corners(), goal, corners_of_arms(record), *nodes]
    corners = np.concatenate(everything).astype(np.float32)
    return corners[np.isfinite(corners).all(-1)]


def film_of_trial(record: TrialRecord) -> Film:
    """A trial: at every moment the search and the plan being followed, and what was executed."""
    ends = np.concatenate([record.points[[0, -1]].reshape(-1, 3), record.goal[None]])
    seen = ends[np.isfinite(ends).all(-1)]

    def set_up(drawing: Drawing) -> None:
        drawing.obstacles("obstacles", record.obstacles, colour=colours.OBSTACLE)
        drawing.text("goal label", "goal", record.goal + np.array([0, 0, 1.2 * record.goal_radius]))

    def show(drawing: Drawing, moment: float) -> None:
        index = plan_at(record, int(moment))
        if index is not None:
            show_plan(drawing, record.plans[index], record.look, point=record.goal_point)
        show_execution(drawing, record, moment)

    return Film(
        title=f"{record.task.replace('_', ' ')} · {record.method} · seed {record.seed}: {record.end}",
        corners=corners_of_trial(record),
        floor=record.look.floor,
        planar=episode_of(record).planar,
        states=len(record.points),
        period=record.period,
        set_up=set_up,
        show=show,
        seen_from=clear_side(seen, record.obstacles),
    )
