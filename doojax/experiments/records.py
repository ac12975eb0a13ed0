"""What was predicted, planned and done, on disk: one file a record, read by the viewer and by anyone else.

A record is an ``.npz`` file: numpy arrays, and in its entry ``header`` UTF-8 JSON with everything else::

    {"format": "doojax trial", "version": 1, "task": "rope_dragging", "points": {"array": "points"}, ...}

An object {"array": NAME} stands for the array of that name. Nothing is pickled. Lengths are metres in the
world frame with z up, times seconds. T1 = T + 1 states have T actions between them.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from doojax.files import whole_file
from doojax.reading import checked, read_arrays
from doojax.simulation.scenes import Scene
from doojax.types import Obstacles

VERSION = 1
GridKind = Literal["distance", "occupancy"]
EventKind = Literal["plan", "execute", "recover", "replan", "end"]


@dataclass(frozen=True)
class Look:
    """The sizes of what is drawn, metres."""

    rope_radius: float
    rope_end: float = 0.0  # how far the rope goes on beyond its first and its last point
    gripper_radius: float = 0.02
    floor: float | None = 0.0  # its height; None where there is none

    @classmethod
    def of(cls, scene: Scene) -> "Look":
        """The sizes of what is in a scene."""
        hands = max(gripper.radius for gripper in scene.grippers)
        if scene.rope is None:
            return cls(scene.plane_height, gripper_radius=hands, floor=0.0 if scene.floor else None)
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
    """What a model predicted, beside what happened. P predictions of up to H steps.

    Prediction p starts from the true state ``start[p]``; its state h is to be compared with the true state
    ``start[p] + h``. What a prediction lacks, being shorter, is NaN.
    """

    task: str
    look: Look
    obstacles: Obstacles
    points: Float[np.ndarray, "T1 N 3"]  # what happened
    grippers: Float[np.ndarray, "T1 G 3"]
    start: Int[np.ndarray, "P"]
    predicted_points: Float[np.ndarray, "P H1 N 3"]
    predicted_grippers: Float[np.ndarray, "P H1 G 3"]
    scores: Mapping[str, Float[np.ndarray, "P H1"]] = field(default_factory=dict)  # of the step that led here
    thresholds: Mapping[str, float] = field(default_factory=dict)  # of some of the scores
    grid: Grid | None = None  # F is 1 or P
    period: float = 1.0  # s between two states
    about: Mapping[str, Any] = field(default_factory=dict)  # seed, model, ...: anything that JSON can hold

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

    def errors(self) -> Float[np.ndarray, "P H1 N"]:
        """Distance of each predicted rope point to the true one, metres; NaN where either is missing."""
        true = np.full(self.predicted_points.shape, np.nan)
        for p, first in enumerate(self.start):
            known = self.points[first : first + true.shape[1]]
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


Record = PredictionRecord | TrialRecord
FORMATS: dict[str, type[Record]] = {"doojax prediction": PredictionRecord, "doojax trial": TrialRecord}


def save_record(path: Path | str, record: Record) -> None:
    """Write a record; the file appears whole or not at all.

    Raises:
        ValueError: for a path that does not end in .npz, or contents that JSON cannot hold.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"a record's file ends in .npz, got {path}")
    arrays: dict[str, np.ndarray] = {}
    (name,) = (name for name, kind in FORMATS.items() if kind is type(record))
    header = {"format": name, "version": VERSION, **_packed(record, "", arrays)}
    try:
        text = json.dumps(header, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: the record holds what JSON cannot: {error}") from error
    everything: dict[str, Any] = {"header": np.frombuffer(text.encode(), np.uint8), **arrays}
    with whole_file(path) as file:
        np.savez_compressed(file, **everything)


def load_record(path: Path | str) -> Record:
    """Read a record.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no record, is damaged, or is of a newer version; the message says which.
    """
    what = "a record that can be read"
    path = Path(path)
    header, arrays = read_arrays(path, what)
    header = header if isinstance(header, dict) else {}
    name, version = header.pop("format", None), header.pop("version", None)
    if not isinstance(name, str) or name not in FORMATS:
        raise ValueError(f"{path} is not a record of doojax: its format is none of {', '.join(FORMATS)}")
    if version != VERSION:
        raise ValueError(
            f"{path} has version {version!r}, this doojax reads version {VERSION}: use a newer doojax"
        )
    try:
        content = _unpacked(header, arrays)
        content["obstacles"] = {name: jnp.asarray(values) for name, values in content["obstacles"].items()}
        return checked(content, FORMATS[name])
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{path} is not {what} ({error})") from error


def _packed(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """``value`` for JSON; arrays are moved to ``arrays`` under the path that leads to them."""
    if is_dataclass(value):
        return {
            one.name: _packed(getattr(value, one.name), f"{name}/{one.name}".lstrip("/"), arrays)
            for one in fields(value)
        }
    if isinstance(value, Mapping):
        return {key: _packed(item, f"{name}/{key}", arrays) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_packed(item, f"{name}/{index}", arrays) for index, item in enumerate(value)]
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "__array__"):
        arrays[name] = np.asarray(value)
        return {"array": name}
    return value


def _unpacked(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if isinstance(value, dict):
        if set(value) == {"array"}:
            return arrays[value["array"]]
        return {key: _unpacked(item, arrays) for key, item in value.items()}
    return [_unpacked(item, arrays) for item in value] if isinstance(value, list) else value


def _expect(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape:
        raise ValueError(f"{name} has shape {np.shape(array)}, expected {shape}")


def _expect_range(name: str, values: np.ndarray, low: int, high: int) -> None:
    if len(values) and not (low <= np.min(values) and np.max(values) <= high):
        raise ValueError(
            f"{name} reaches from {np.min(values)} to {np.max(values)}, expected {low} to {high}"
        )
