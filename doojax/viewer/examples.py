"""Made-up data sets and records to try the viewer on: a towed rope among boxes, without physics."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial import KDTree

from doojax.datasets import DatasetWriter, Field
from doojax.experiments.trials.outcomes import CONFIG, METHOD
from doojax.experiments.trials.record_files import save_record
from doojax.experiments.trials.records import Event, Grid, Look, PlanRecord, PredictionRecord, TrialRecord
from doojax.experiments.trials.trial_list import LIST, line_of, note_trial
from doojax.geometry import signed_distance
from doojax.types import Obstacles, ShapeKind

POINTS, PITCH, RADIUS = 10, 0.05, 0.02
LOOK = Look(rope_radius=RADIUS, rope_end=PITCH / 2, gripper_radius=0.02)
BOXES = 4
STATES = 30
STEP = 0.06  # m, the longest move of the gripper
ARENA = 1.0  # m from the middle to its edge
BLOCK = 256  # extensions of a tree at once


def tow(
    points: Float[np.ndarray, "*b N 3"], gripper: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "*b N 3"]:
    """Each point follows the next at its distance; the last one is where the gripper is."""
    towed = np.array(points)
    towed[..., -1, :] = gripper
    for i in range(towed.shape[-2] - 2, -1, -1):
        gap = towed[..., i, :] - towed[..., i + 1, :]
        towed[..., i, :] = towed[..., i + 1, :] + PITCH * gap / np.linalg.norm(gap, axis=-1, keepdims=True)
    return towed


def straight(count: int, generator: np.random.Generator) -> Float[np.ndarray, "count N 3"]:
    """Straight ropes on the floor."""
    angle = generator.uniform(0, 2 * np.pi, (count, 1, 1))
    along = PITCH * np.arange(POINTS)[None, :, None]
    tail = np.append(generator.uniform(-0.4, 0.4, (count, 1, 2)), np.full((count, 1, 1), RADIUS), axis=-1)
    return tail + along * np.concatenate([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)


def wander(count: int, states: int, generator: np.random.Generator) -> Float[np.ndarray, "count states N 3"]:
    """Ropes towed about at random."""
    ropes = [straight(count, generator)]
    heading = generator.uniform(0, 2 * np.pi, count)
    for _ in range(states - 1):
        heading += generator.normal(0, 0.5, count)
        move = STEP * np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=-1)
        target = ropes[-1][:, -1] + move
        outside = np.abs(target[:, :2]).max(-1) > 0.9
        heading[outside] += np.pi
        target[outside] -= 2 * move[outside]
        ropes.append(tow(ropes[-1], target))
    return np.stack(ropes, axis=1).astype(np.float32)


def boxes(generator: np.random.Generator) -> Obstacles:
    """A few boxes, a cylinder and a lying capsule."""
    place = np.append(generator.uniform(-0.8, 0.8, (BOXES + 2, 2)), np.full((BOXES + 2, 1), 0.1), axis=1)
    yaw = generator.uniform(0, np.pi, BOXES + 2)
    turn = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)
    half = np.tile([0.12, 0.08, 0.1], (BOXES + 2, 1))
    half[-2:] = [[0.08, 0.08, 0.1], [0.05, 0.05, 0.12]]
    turn[-1], place[-1, 2] = [np.cos(np.pi / 4), np.sin(np.pi / 4), 0, 0], 0.05
    kind = [ShapeKind.BOX] * BOXES + [ShapeKind.CYLINDER, ShapeKind.CAPSULE]
    return Obstacles(
        kind=jnp.array(kind, dtype=jnp.int32),
        centre=jnp.array(place, dtype=jnp.float32),
        quaternion=jnp.array(turn, dtype=jnp.float32),
        half_size=jnp.array(half, dtype=jnp.float32),
        active=jnp.ones(BOXES + 2, dtype=bool),
    )


def write_dataset(
    path: Path, trajectories: int, *, seed: int = 0, states: int = STATES, shards: int | None = None
) -> None:
    """Write a data set; if ``shards`` is given, only so many, as if collecting had been cut short."""
    shapes = BOXES + 2
    schema = {
        "points": Field((states, POINTS, 3), "float32", "m", "points along the rope"),
        "grippers": Field((states, 1, 3), "float32", "m", "gripper positions"),
        "actions": Field((states - 1, 1, 3), "float32", "m", "gripper displacements"),
        "faults": Field((states - 1,), "int32", "1", "fault bits"),
        "clearance": Field((states,), "float32", "m", "distance to the nearest obstacle"),
        "stretch": Field((states,), "float32", "1", "lengthening over length"),
        "obstacle_kind": Field((shapes,), "int32", "1", "shape"),
        "obstacle_centre": Field((shapes, 3), "float32", "m", "centre"),
        "obstacle_quaternion": Field((shapes, 4), "float32", "1", "body to world"),
        "obstacle_half_size": Field((shapes, 3), "float32", "m", "half size"),
        "obstacle_active": Field((shapes,), "bool", "1", "is it there"),
        "environment": Field((), "int32", "1", "number of the scene"),
    }
    config = {"task": "rope_dragging", "phase": "constrained", "engine": "none", "seed": seed}
    writer = DatasetWriter.open(path, config=config, schema=schema, n=trajectories)
    for shard in writer.missing_shards()[:shards]:
        rows = writer.manifest.rows(shard)
        generator = np.random.default_rng([seed, shard])
        ropes = wander(len(rows), states, generator)
        obstacles = boxes(generator)
        grippers = ropes[:, :, -1:]
        towards = np.linalg.norm(np.asarray(obstacles.centre)[:, :2] - grippers[..., :2], axis=-1)
        values = {
            "points": ropes,
            "grippers": grippers,
            "actions": np.diff(grippers, axis=1),
            "faults": np.zeros((len(rows), states - 1), np.int32),
            "clearance": towards.min(-1).astype(np.float32) - np.float32(0.1),
            "stretch": np.abs(generator.normal(0, 0.002, (len(rows), states))).astype(np.float32),
            "environment": np.full(len(rows), shard, np.int32),
        }
        for name, value in vars(obstacles).items():
            values[f"obstacle_{name}"] = np.repeat(np.asarray(value)[None], len(rows), axis=0)
        writer.write(shard, values)
    if not writer.missing_shards():
        writer.finish()


def prediction_record(*, seed: int = 0, predictions: int = 5, horizon: int = 10) -> PredictionRecord:
    """A model that errs the more, the further it looks ahead, with a classifier that notices."""
    generator = np.random.default_rng(seed)
    obstacles = boxes(generator)
    ropes = wander(1, STATES, generator)[0]
    start = np.linspace(0, STATES - horizon - 1, predictions).astype(int)
    true = np.stack([ropes[first : first + horizon + 1] for first in start])
    drift = generator.normal(0, 1, (predictions, 1, 1, 3)) * [1, 1, 0]
    ahead = np.arange(horizon + 1)[None, :, None, None] / horizon
    away = np.linspace(1, 0.3, POINTS)[None, None, :, None]
    predicted = (true + 0.06 * drift * ahead**1.5 * away).astype(np.float32)
    error = np.linalg.norm(predicted - true, axis=-1).mean(-1)
    size, spacing = 48, 2.4 / 48
    axis = spacing * (np.arange(size) - (size - 1) / 2)
    height = spacing * np.arange(4) + RADIUS
    places = np.stack(np.meshgrid(axis, axis, height, indexing="ij"), axis=-1)
    distance = np.asarray(signed_distance(obstacles, jnp.array(places, dtype=jnp.float32)))
    return PredictionRecord(
        task="rope_dragging",
        look=LOOK,
        obstacles=obstacles,
        points=ropes,
        grippers=ropes[:, -1:],
        start=start,
        predicted_points=predicted,
        predicted_grippers=predicted[:, :, -1:],
        scores={
            "accept probability": 1 / (1 + np.exp(80 * (error - 0.04))),
            "ensemble deviation (m)": 0.6 * error + 0.002,
        },
        thresholds={"accept probability": 0.5},
        accepted=error < 0.04,
        error_threshold=0.03,
        grid=Grid(distance[None], np.array([[axis[0], axis[0], height[0]]]), spacing),
        about={"seed": seed, "model": "made up"},
    )


@jax.jit
def clear(obstacles: Obstacles, ropes: Float[Array, "K N 3"]) -> Bool[Array, "K"]:
    """Which ropes touch no obstacle and stay in the arena."""
    inside = (jnp.abs(ropes[..., :2]) < ARENA).all((1, 2))
    return (signed_distance(obstacles, ropes) > RADIUS).all(-1) & inside


def plan_record(
    nodes: int,
    generator: np.random.Generator,
    obstacles: Obstacles,
    root: Float[np.ndarray, "N 3"],
    step: int,
    goal: Float[np.ndarray, "3"] | None = None,
) -> PlanRecord:
    """A tree that explores the arena from a rope, and the path to the node whose tail is nearest to a goal.

    Without a goal the path leads to the node whose tail is farthest from the root's.
    """
    parent, accepted = np.full(nodes, -1), np.ones(nodes, dtype=bool)
    ropes = np.empty((nodes, POINTS, 3), dtype=np.float32)
    ropes[0] = root
    done = 1
    while done < nodes:
        count = min(max(done // 8, 8), BLOCK, nodes - done)
        target = np.append(generator.uniform(-ARENA, ARENA, (BLOCK, 2)), np.full((BLOCK, 1), RADIUS), axis=1)
        usable = np.flatnonzero(accepted[:done])
        nearest = usable[KDTree(ropes[usable, -1]).query(target)[1]]
        way = target - ropes[nearest, -1]
        way *= np.minimum(1, STEP / np.linalg.norm(way, axis=-1, keepdims=True))
        moved = tow(ropes[nearest], ropes[nearest, -1] + way)
        block = slice(done, done + count)
        ropes[block], parent[block] = moved[:count], nearest[:count]
        accepted[block] = np.asarray(clear(obstacles, jnp.array(moved)))[:count]
        done += count
    aim = root[0] if goal is None else goal
    distance = np.linalg.norm(ropes[:, 0] - aim, axis=-1)
    wanted = np.where(accepted, distance if goal is None else -distance, -np.inf)
    path = [int(np.argmax(wanted))]
    while parent[path[-1]] >= 0:
        path.append(int(parent[path[-1]]))
    score = np.where(accepted, generator.uniform(0.5, 1, nodes), generator.uniform(0, 0.5, nodes))
    return PlanRecord(
        step=step,
        parent=parent,
        points=ropes,
        grippers=ropes[:, -1:],
        accepted=accepted,
        path=np.array(path[::-1]),
        score=score,
    )


def write_evaluation(folder: Path, scenes: int, methods: Sequence[str]) -> None:
    """An evaluation's folder: the first method reaches the goal everywhere, others in every other scene."""
    for number, method in enumerate(methods):
        (folder / method).mkdir(parents=True)
        (folder / method / METHOD).write_text("{}")
        for scene in range(scenes):
            record = trial_record(seed=scene, nodes=64)
            if number and scene % 2:
                end = (
                    *record.events[:-1],
                    Event(len(record.points) - 1, "end", "10 searches did not suffice"),
                )
                record = replace(record, reached=False, events=end)
            record = replace(record, method=method, about={"final_error_m": 0.01 * (scene + 1)})
            save_record(folder / method / f"{scene:05d}.npz", record)
            note_trial(folder / method, line_of(record, scene))
    (folder / CONFIG).write_text('{"task": "rope_dragging", "seed": 0}')


def write_long_list(folder: Path, trials: int) -> None:
    """An evaluation of one method with more trials than records: the files of the others are empty."""
    write_evaluation(folder, 4, ["classifier"])
    listed = folder / "classifier" / LIST
    first = json.loads(listed.read_text().splitlines()[0])
    lines = [json.dumps(first | {"trial": number, "reached": number % 3 > 0}) for number in range(trials)]
    listed.write_text("\n".join(lines) + "\n")
    for number in range(4, trials):
        (folder / "classifier" / f"{number:05d}.npz").touch()


def trial_record(*, seed: int = 0, nodes: int = 1500) -> TrialRecord:
    """Two plans: the first is left, there is a recovery, and the second is executed."""
    generator = np.random.default_rng(seed)
    obstacles = boxes(generator)
    starts = straight(32, generator)
    start = starts[np.argmax(np.asarray(clear(obstacles, jnp.array(starts))))].astype(np.float32)
    first = plan_record(nodes, generator, obstacles, start, 0)
    goal = first.points[first.path[-1], 0].astype(np.float64)
    executed = list(first.points[first.path[: max(len(first.path) // 3, 2)]])
    stuck = len(executed) - 1
    for _ in range(2):
        executed.append(tow(executed[-1], 2 * executed[-1][-1] - executed[-2][-1]).astype(np.float32))
    again = len(executed) - 1
    second = plan_record(nodes, generator, obstacles, executed[-1], again, goal)
    executed += list(second.points[second.path[1:]])
    ropes = np.stack(executed)
    last = len(ropes) - 1
    distance = float(np.linalg.norm(ropes[-1, 0] - goal))
    radius = 0.05
    reached = distance < radius
    end = "goal reached" if reached else f"plan executed, tail {100 * distance:.0f} cm from the goal"
    accepted = [plan.accepted.sum() - 1 for plan in (first, second)]
    counts = [f"solved: {count:,} of {nodes - 1:,} extensions accepted" for count in accepted]
    events = (
        Event(0, "plan", counts[0]),
        Event(0, "execute", f"{len(first.path) - 1} actions"),
        Event(stuck, "replan", "7.1 cm from where the plan had the rope"),
        Event(stuck, "recover", "nothing that was tried is reliable"),
        Event(again, "plan", counts[1]),
        Event(again, "execute", f"{len(second.path) - 1} actions"),
        Event(last, "end", end),
    )
    return TrialRecord(
        task="rope_dragging",
        method="made up",
        seed=seed,
        look=LOOK,
        obstacles=obstacles,
        goal=goal,
        goal_radius=radius,
        goal_point=0,
        points=ropes,
        grippers=ropes[:, -1:],
        plans=(first, second),
        events=events,
        reached=reached,
    )
