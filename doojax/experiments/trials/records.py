"""What was predicted, planned and done, as arrays: what `record_files` keeps on disk.

Lengths are metres in the world frame with z up, times seconds. T1 = T + 1 states have T actions between them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from doojax.simulation.fluid.pouring import PouringScene
from doojax.types import Obstacles

GridKind = Literal["distance", "occupancy"]
EventKind = Literal["plan", "execute", "recover", "replan", "end"]
What = Literal["rope", "container", "body"]
PLACE = 2  # among the points of a container: its own place; the first two are gauges, see `PouringState`
OUTLINE = (2, 0, 1, 3)  # of its corners, as a way from rim to rim


@dataclass(frozen=True)
class Look:
    """The sizes of what is drawn, metres."""

    rope_radius: float
    rope_end: float = 0.0  # how far the rope goes on beyond its first and its last point
    gripper_radius: float = 0.02
    floor: float | None = 0.0  # its height; None where there is none
    what: What = "rope"
    """A rope's points and grippers, what is seen of a container that pours, or bodies that a hand pushes."""

    @classmethod
    def of(cls, scene: Any) -> "Look":
        """The sizes of what is in a scene."""
        hands = max((gripper.radius for gripper in scene.grippers), default=cls.gripper_radius)
        if scene.rope is None:
            what: What = "container" if isinstance(scene, PouringScene) else "rope"
            if getattr(scene, "cylinders", ()):
                what = "body"
            return cls(
                scene.plane_height, gripper_radius=hands, floor=0.0 if scene.floor else None, what=what
            )
        half_link = scene.rope_part.parameters.length / scene.links / 2
        return cls(
            rope_radius=scene.rope_part.parameters.radius,
            rope_end=0.0 if scene.rope_part.model.kind == "point_masses" else half_link,
            gripper_radius=hands,
            floor=0.0 if scene.floor else None,
        )


@dataclass(frozen=True, eq=False)
class Grid:
    """Values on regular grids that a model saw: one grid for all predictions or one for each."""

    values: Float[np.ndarray, "F X Y Z"]  # metres for distances, 0 to 1 for occupancy
    origin: Float[np.ndarray, "F 3"]  # centre of the voxel [0, 0, 0]
    spacing: float  # between the centres of two voxels
    kind: GridKind = "distance"  # signed, negative inside

    def __post_init__(self):
        """Refuse unknown kinds and arrays that do not fit together."""
        if self.kind not in get_args(GridKind):
            raise ValueError(
                f"a grid's kind is {self.kind!r}, expected one of {', '.join(get_args(GridKind))}"
            )
        _expect("origin", self.origin, (len(self.values), 3))

    @property
    def inside(self) -> Bool[np.ndarray, "F X Y Z"]:
        """The voxels that an obstacle fills."""
        return self.values > 0.5 if self.kind == "occupancy" else self.values < 0


@dataclass(frozen=True, eq=False)
class PredictionRecord:
    """What a model predicted, beside what happened. P predictions of up to H steps along K trajectories.

    Prediction p starts from the true state ``start[p]``; its state h is to be compared with the true state
    ``start[p] + h``. What a prediction lacks, being shorter or beyond its trajectory's end, is NaN.
    """

    task: str
    look: Look
    obstacles: Obstacles  # [M], or [K, M] of each trajectory
    points: Float[np.ndarray, "T1 N 3"]  # what happened, one trajectory after another
    grippers: Float[np.ndarray, "T1 G 3"]
    start: Int[np.ndarray, "P"]
    predicted_points: Float[np.ndarray, "P H1 N 3"]
    predicted_grippers: Float[np.ndarray, "P H1 G 3"]
    scores: Mapping[str, Float[np.ndarray, "P H1"]] = field(default_factory=dict)  # of the step that led here
    thresholds: Mapping[str, float] = field(default_factory=dict)  # of some of the scores
    grid: Grid | None = None  # F is 1 or P
    period: float = 1.0  # s between two states
    about: Mapping[str, Any] = field(default_factory=dict)  # seed, model, ...: anything that JSON can hold
    begins: Int[np.ndarray, "K"] = field(
        default_factory=lambda: np.zeros(1, int)
    )  # trajectories' first states
    rows: Int[np.ndarray, "K"] | None = None  # their numbers in the data set
    accepted: Bool[np.ndarray, "P H1"] | None = None  # by the judge of reliability: the step that led here
    error_threshold: float | None = None  # m of the error, RMS over the points, below which a step is right

    def __post_init__(self):
        """Refuse arrays that do not fit together."""
        states, count, grippers = len(self.points), self.points.shape[1], self.grippers.shape[1]
        moments = self.predicted_points.shape[:2]
        _expect("grippers", self.grippers, (states, grippers, 3))
        _expect("start", self.start, moments[:1])
        _expect("predicted_points", self.predicted_points, (*moments, count, 3))
        _expect("predicted_grippers", self.predicted_grippers, (*moments, grippers, 3))
        _expect_range("start", self.start, 0, states - 1)
        for name, values in self.scores.items():
            _expect(f"scores[{name!r}]", values, moments)
        unknown = set(self.thresholds) - set(self.scores)
        if unknown:
            raise ValueError(f"thresholds name no scores: {sorted(unknown)}; there are {sorted(self.scores)}")
        if self.grid is not None and len(self.grid.values) not in (1, moments[0]):
            raise ValueError(f"grid has {len(self.grid.values)} grids, expected 1 or {moments[0]}")
        if self.begins[:1].tolist() != [0] or (np.diff(self.begins) <= 0).any():
            raise ValueError(f"begins is {self.begins.tolist()}, expected rising numbers from 0 on")
        _expect_range("begins", self.begins, 0, states - 1)
        if self.rows is not None:
            _expect("rows", self.rows, self.begins.shape)
        if self.accepted is not None:
            _expect("accepted", self.accepted, moments)
        if self.obstacles.kind.ndim > 1:
            kind = np.asarray(self.obstacles.kind)
            _expect("obstacles.kind", kind, (len(self.begins), *kind.shape[1:]))

    def trajectory(self, prediction: int) -> int:
        """Along which of the K trajectories a prediction goes."""
        return int(np.searchsorted(self.begins, self.start[prediction], side="right")) - 1

    def states(self, trajectory: int) -> slice:
        """The states of one trajectory."""
        ends = [*self.begins[1:].tolist(), len(self.points)]
        return slice(int(self.begins[trajectory]), ends[trajectory])

    def obstacles_of(self, trajectory: int) -> Obstacles:
        """What stands in the way of one trajectory, [M]."""
        if self.obstacles.kind.ndim == 1:
            return self.obstacles
        return jax.tree.map(lambda leaf: leaf[trajectory], self.obstacles)

    def rms_errors(self) -> Float[np.ndarray, "P H1"]:
        """Root mean square of `errors` over the points, metres; NaN where it is not known."""
        return np.sqrt((self.errors() ** 2).mean(-1))

    def counted(self) -> Bool[np.ndarray, "P H1"]:
        """Which steps say something of a judge: those that begin where the prediction was still right.

        As for labels: what follows a prediction's first error above the threshold is left out.
        """
        if self.error_threshold is None:
            return np.zeros(self.predicted_points.shape[:2], dtype=bool)
        error = self.rms_errors()
        with np.errstate(invalid="ignore"):
            wrong = ~(error < self.error_threshold)
        before = np.maximum.accumulate(wrong, axis=1)
        counted = np.zeros_like(wrong)
        counted[:, 1:] = ~before[:, :-1]
        return counted & np.isfinite(error)

    def mistaken(self) -> tuple[Bool[np.ndarray, "P H1"], Bool[np.ndarray, "P H1"]]:
        """False accepts (accepted, but wrong) and false rejects (rejected, but right), of `counted` steps."""
        counted = self.counted()
        if self.accepted is None or self.error_threshold is None:
            return np.zeros_like(counted), np.zeros_like(counted)
        with np.errstate(invalid="ignore"):
            right = self.rms_errors() < self.error_threshold
        return counted & self.accepted & ~right, counted & ~self.accepted & right

    def errors(self) -> Float[np.ndarray, "P H1 N"]:
        """Distance of each predicted rope point to the true one, metres; NaN where either is missing."""
        true = np.full(self.predicted_points.shape, np.nan)
        for p, first in enumerate(self.start):
            known = self.points[first : min(first + true.shape[1], self.states(self.trajectory(p)).stop)]
            true[p, : len(known)] = known
        return np.linalg.norm(self.predicted_points - true, axis=-1)


@dataclass(frozen=True, eq=False)
class PlanRecord:
    """One search: a tree of n nodes, those that were rejected included, and the path that was chosen."""

    step: int  # executed states before this plan was made: it starts from state ``step``
    parent: Int[np.ndarray, "_n"]  # index of each node's parent, which stands before it; -1 for the root
    points: Float[np.ndarray, "_n N 3"]
    grippers: Float[np.ndarray, "_n G 3"]
    accepted: Bool[np.ndarray, "_n"]  # false: an extension that was tried and rejected
    path: Int[np.ndarray, "_m"]  # nodes from the root on; empty where nothing was found
    score: Float[np.ndarray, "_n"] | None = None  # of the extension that led here, as the reliability gave it

    def __post_init__(self):
        """Refuse arrays that do not fit together."""
        nodes = len(self.parent)
        _expect("points", self.points, (nodes, *self.points.shape[1:2], 3))
        _expect("grippers", self.grippers, (nodes, *self.grippers.shape[1:2], 3))
        _expect("accepted", self.accepted, (nodes,))
        if self.score is not None:
            _expect("score", self.score, (nodes,))
        _expect_range("path", self.path, 0, nodes - 1)
        late = np.flatnonzero((self.parent >= np.arange(nodes)) | (self.parent < -1))
        if late.size:
            raise ValueError(
                f"parent of node {late[0]} is {self.parent[late[0]]}, expected an earlier node, or -1 (root)"
            )

    def depth(self) -> Int[np.ndarray, "n"]:
        """Steps from the root to each node."""
        depth = np.zeros(len(self.parent), dtype=int)
        for node in np.flatnonzero(self.parent >= 0):
            depth[node] = depth[self.parent[node]] + 1
        return depth


@dataclass(frozen=True)
class Event:
    """Something that happened during a trial, when state ``step`` had been reached."""

    step: int
    kind: EventKind
    text: str = ""

    def __post_init__(self):
        """Refuse unknown kinds."""
        if self.kind not in get_args(EventKind):
            raise ValueError(f"event kind is {self.kind!r}, expected one of {', '.join(get_args(EventKind))}")


@dataclass(frozen=True, eq=False)
class TrialRecord:
    """Planning and execution towards one goal."""

    task: str
    method: str
    seed: int
    look: Look
    obstacles: Obstacles
    goal: Float[np.ndarray, "3"]
    goal_radius: float  # m, within which the goal is reached
    goal_point: int  # which body is to reach it: the rope's points are counted first, then the grippers
    points: Float[np.ndarray, "T1 N 3"]  # what was executed
    grippers: Float[np.ndarray, "T1 G 3"]
    plans: tuple[PlanRecord, ...]
    events: tuple[Event, ...]  # in order; the last is the end and says why
    reached: bool
    period: float = 1.0  # s between two states
    about: Mapping[str, Any] = field(default_factory=dict)  # anything that JSON can hold
    replay: Mapping[str, np.ndarray] = field(default_factory=dict)  # first state and actions

    def __post_init__(self):
        """Refuse arrays that do not fit together."""
        _expect("goal", self.goal, (3,))
        _expect("grippers", self.grippers, (len(self.points), *self.grippers.shape[1:2], 3))
        bodies = self.points.shape[1] + self.grippers.shape[1]
        _expect_range("goal_point", np.array([self.goal_point]), 0, bodies - 1)
        for name, items in (("plans", self.plans), ("events", self.events)):
            _expect_range(f"step of {name}", np.array([item.step for item in items]), 0, len(self.points) - 1)

    @property
    def shown_point(self) -> int:
        """The body by whose places searches and ways are shown: gauges would tell nothing of them."""
        return PLACE if self.look.what == "container" else self.goal_point

    @property
    def goal_way(self) -> Float[np.ndarray, "T1 3"]:
        """Where the body that is to reach the goal was, metres."""
        return body_of(self.points, self.grippers, self.goal_point)

    @property
    def end(self) -> str:
        """Why the trial ended."""
        return (
            self.events[-1].text if self.events and self.events[-1].kind == "end" else "no end was recorded"
        )


def body_of(
    points: Float[np.ndarray, "*b N 3"], grippers: Float[np.ndarray, "*b G 3"], index: int
) -> Float[np.ndarray, "*b 3"]:
    """One of the bodies, the rope's points counted first and then the grippers."""
    count = points.shape[-2]
    return points[..., index, :] if index < count else grippers[..., index - count, :]


def solid_of(
    points: Float[np.ndarray, "*b N 3"], grippers: Float[np.ndarray, "*b G 3"], look: Look
) -> tuple[Float[np.ndarray, "*b K 3"], Float[np.ndarray, "*b H 3"]]:
    """What can touch something, m: a line and balls. A rope and its grippers, or a container's outline."""
    if look.what == "container":
        return grippers[..., list(OUTLINE), :], grippers[..., :0, :]
    return points, grippers


Record = PredictionRecord | TrialRecord


def _expect(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape:
        raise ValueError(f"{name} has shape {np.shape(array)}, expected {shape}")


def _expect_range(name: str, values: np.ndarray, low: int, high: int) -> None:
    if len(values) and not (low <= np.min(values) and np.max(values) <= high):
        raise ValueError(
            f"{name} reaches from {np.min(values)} to {np.max(values)}, expected {low} to {high}"
        )
