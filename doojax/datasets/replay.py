"""Run a stored trajectory again: `doojax replay`. Also saves the elements of a rollout that failed."""

import json
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from rich.console import Console
from rich.table import Column, Table

from doojax.datasets.progress import announce
from doojax.datasets.store import Dataset
from doojax.files import whole_file
from doojax.reading import NumberKind, checked, read_arrays, require_arrays
from doojax.simulation.engines import resolve_engine
from doojax.simulation.state import Fault, SimState
from doojax.tasks import make_task
from doojax.tasks.ropes import task_of
from doojax.types import State, Trajectory

MODEL = "model/"  # before the names of model fields, which carry another rope
_STATE_FIELDS = ("qpos", "qvel", "commanded", "obstacle_position", "obstacle_quaternion", "holding")


@dataclass(frozen=True)
class FailuresHeader:
    """What a file of failures says beside its arrays."""

    task: str
    elements: list[int]  # their numbers in the batch that they come from


def save_failures(
    path: Path, task: str, starts: SimState, actions: Float[Array, "B T G 3"], trajectory: Trajectory
) -> int:
    """Save those of a rollout's B elements that have a fault, so that `doojax replay` can run them again.

    Args:
        path: the .npz file to write.
        task: the name of the task whose scene was simulated.
        starts: the states that the rollout began with.
        actions: m.
        trajectory: what the rollout returned.

    Returns:
        how many were saved; no file is written for none.
    """
    failed = np.flatnonzero(np.any(np.asarray(trajectory.faults) != 0, axis=1))
    if failed.size:
        arrays = {name: np.asarray(getattr(starts, name))[failed] for name in _STATE_FIELDS}
        arrays |= {MODEL + name: np.asarray(values)[failed] for name, values in starts.model_fields.items()}
        arrays["actions"] = np.asarray(actions)[failed]
        arrays["points"] = np.asarray(trajectory.states.points)[failed]
        arrays["faults"] = np.asarray(trajectory.faults)[failed]
        header = json.dumps({"task": task, "elements": failed.tolist()})
        arrays["header"] = np.frombuffer(header.encode(), np.uint8)
        with whole_file(path) as file:
            np.savez(file, allow_pickle=False, **arrays)
    return int(failed.size)


def replay(path: Path, /, *, trajectory: int = 0, engine: str = "auto") -> None:
    """Simulate a stored trajectory again and say where it departs from what was stored.

    Args:
        path: a data set, or a file of failures written by `doojax.datasets.replay.save_failures`.
        trajectory: its number there.
        engine: to replay on; `auto` is the one that made the data set.

    Raises:
        ValueError: for a number that does not exist, or a path that holds neither.
    """
    console = Console()
    if path.is_dir():
        dataset = Dataset.open(path)
        made_with, state, actions, points, faults = _from_dataset(dataset, trajectory)
        task = task_of(dataset.config)
        scene = dataset.config.get("scene")
        if scene is None:
            console.print(
                f"[yellow]of which scene of {task.name} these are is not recorded: it may differ[/yellow]"
            )
        elif scene != task.scene.digest:
            console.print(f"[yellow]the scene of {task.name} has changed since these were collected[/yellow]")
    else:
        name, made_with, state, actions, points, faults = _from_failures(path, trajectory)
        task = make_task(name)
    engine = resolve_engine(made_with if engine == "auto" else engine)
    announce(f"simulating trajectory {trajectory} of {task.name} on {engine}; mjx compiles first")
    simulator = task.simulator(engine)
    batch = jax.tree.map(lambda leaf: leaf[None], (state, actions))
    _, again = simulator.rollout(*batch)
    found = np.asarray(_passive(again.states)[0])
    _show(console, found, points, np.asarray(again.faults[0]), faults, again)


def stored_starts(dataset: Dataset, rows: Int[np.ndarray, "B"]) -> SimState:
    """The states that some of a data set's trajectories were simulated from, [B]."""
    count, bodies = len(rows), (jnp.zeros((len(rows), 0, 3)), jnp.zeros((len(rows), 0, 4)))
    if "body_position" in dataset.fields:
        bodies = tuple(jnp.asarray(dataset[f"body_{name}"][rows]) for name in ("position", "quaternion"))
    return SimState(
        qpos=jnp.asarray(dataset["initial_qpos"][rows]),
        qvel=jnp.asarray(dataset["initial_qvel"][rows]),
        commanded=jnp.asarray(dataset["initial_commanded"][rows]),
        obstacle_position=bodies[0],
        obstacle_quaternion=bodies[1],
        holding=jnp.ones((count, len(task_of(dataset.config).scene.layout.holds)), dtype=bool),
        faults=jnp.zeros(count, dtype=jnp.int32),
        model_fields={},
    )


def _from_dataset(dataset: Dataset, number: int):
    if not 0 <= number < len(dataset):
        raise ValueError(f"there is no trajectory {number}: {dataset.path} holds 0 to {len(dataset) - 1}")
    if not np.isfinite(dataset["initial_qpos"][number]).all():
        raise ValueError(
            f"the start of trajectory {number} of {dataset.path} is not stored: it was "
            "rejected as an augmentation, or begins within a trajectory"
        )
    return (
        dataset.config["engine"],
        jax.tree.map(lambda leaf: leaf[0], stored_starts(dataset, np.array([number]))),
        jnp.asarray(dataset["actions"][number]),
        np.asarray(_passive(dataset.states(number, type(task_of(dataset.config).blank)))),
        dataset["faults"][number],
    )


def _passive(states: State) -> Float[Array, "*b K 3"]:
    """Where the bodies are that no action commands, m."""
    return states.bodies()[..., : states.passive, :]


def _from_failures(path: Path, number: int):
    what = "a data set or a file of saved failures"
    content, stored = read_arrays(path, what)
    try:
        header = checked(content, FailuresHeader)
        _check_failures(header, stored)
    except ValueError as error:
        raise ValueError(f"{path} is not {what}: {error}") from error
    if not 0 <= number < len(header.elements):
        raise ValueError(f"there is no failure {number}: {path} holds 0 to {len(header.elements) - 1}")
    state = SimState(
        **{name: jnp.asarray(stored[name][number]) for name in _STATE_FIELDS},
        faults=jnp.array(0, dtype=jnp.int32),
        model_fields={
            name.removeprefix(MODEL): jnp.asarray(values[number])
            for name, values in stored.items()
            if name.startswith(MODEL)
        },
    )
    actions = jnp.asarray(stored["actions"][number])
    return header.task, "auto", state, actions, stored["points"][number], stored["faults"][number]


def _check_failures(header: FailuresHeader, stored: dict[str, np.ndarray]) -> None:
    task, count = make_task(header.task), len(header.elements)
    scene, bodies = task.scene, len(task.scene.obstacles)
    periods = stored.get("actions", np.zeros(0)).shape[1:2]
    states = tuple(number + 1 for number in periods)
    expected: dict[str, tuple[NumberKind, tuple[int, ...]]] = {
        "qpos": ("float", (count, scene.nq)),
        "qvel": ("float", (count, scene.nv)),
        "obstacle_position": ("float", (count, bodies, 3)),
        "obstacle_quaternion": ("float", (count, bodies, 4)),
        "holding": ("bool", (count, task.grippers)),
        "actions": ("float", (count, *periods, task.grippers, 3)),
        "points": ("float", (count, *states, scene.links, 3)),
        "faults": ("int", (count, *periods)),
    }
    require_arrays(stored, expected)


def _show(console: Console, points, stored_points, faults, stored_faults, again: Trajectory) -> None:
    gap = np.linalg.norm(points - stored_points, axis=-1).max(-1)
    heads = ("period", "gap to\nstored (m)", "clearance\n(m)", "stretch", "faults", "stored\nfaults")
    columns = (Column(head, no_wrap=True) for head in heads)  # all of it in a terminal of 80 columns
    table = Table(*columns, box=None, padding=(0, 1, 0, 0))
    for period in range(len(faults)):
        table.add_row(
            str(period),
            f"{gap[period + 1]:.3g}",
            f"{float(again.clearance[0, period + 1]):.4f}",
            f"{float(again.stretch[0, period + 1]):.2%}",
            _names(int(faults[period])),
            _names(int(stored_faults[period])),
        )
    console.print(table)
    same = np.array_equal(points, stored_points, equal_nan=True)
    if same and np.array_equal(faults, stored_faults):
        console.print("the replay equals what was stored, bit for bit")
    else:
        console.print(f"largest gap {np.nanmax(gap):.3g} m")


def _names(faults: int) -> str:
    return (Fault(faults).name or "-").replace("|", "\n")
