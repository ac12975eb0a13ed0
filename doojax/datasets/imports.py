"""Trajectories that doojax did not make, as a data set to learn from: `doojax import`."""

import csv
from collections import defaultdict
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console

from doojax.datasets.collect import STATES
from doojax.datasets.manifest import Field
from doojax.datasets.writer import DatasetWriter
from doojax.files import alone_in, file_digest
from doojax.geometry.sdf import signed_distance
from doojax.reading import read_text
from doojax.simulation.scenes import Scene
from doojax.tasks import make_task
from doojax.tasks.base import Phase, Task
from doojax.types import Obstacles, RopeState

SHARD_SIZE = 64
OBSTACLES = tuple(f"obstacle_{name}" for name in Obstacles.__annotations__)
NEEDED, OPTIONAL = ("points", "grippers"), ("actions", "environment", *OBSTACLES)
AXES = "xyz"


def import_trajectories(file: Path, /, *, task: str, phase: Phase = "unconstrained", out: Path) -> None:
    """Make a data set of trajectories that were recorded elsewhere, in metres, for doojax train.

    A .npz holds the arrays points [K, T+1, N, 3] (the centres of the rope's links) and grippers
    [K, T+1, G, 3]; if it has them, also actions [K, T, G, 3] (displacements that were commanded; by default
    those that were made), environment [K] (trajectories with one number share a scene, and so a split) and
    obstacle_kind, obstacle_centre, obstacle_quaternion, obstacle_half_size and obstacle_active [K, M, ...]
    (see doojax.types.Obstacles; by default there are none).

    A .csv has a line for each state: trajectory, step, point0_x, point0_y, point0_z, ..., gripper0_x, ...

    Args:
        file: the .npz or .csv.
        task: whose rope and hands they are of.
        phase: unconstrained (nothing in the way) or constrained; then the obstacles must be there.
        out: the data set's folder; new or empty.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: for what does not fit the task, is not finite, or is missing; the message says what.
    """
    the_task = make_task(task, phase=phase)
    if not isinstance(the_task.blank, RopeState):
        raise ValueError(f"states of {task} are not of a rope and hands alone: it has no import")
    given = read_csv(file) if file.suffix == ".csv" else read_npz(file)
    if phase == "constrained" and OBSTACLES[0] not in given:
        raise ValueError(f"{file} has no obstacles, which phase constrained needs: {', '.join(OBSTACLES)}")
    arrays = stored(the_task, given, file)
    count, states = arrays["points"].shape[:2]
    sha256 = file_digest(file)
    config = {
        "task": task,
        "stream": f"import/{sha256[:16]}",
        "seed": 0,
        "scene": the_task.scene.digest,
        "phase": phase,
        "states": states,
        "imported": {"file": file.name, "sha256": sha256},
    }
    with alone_in(out):
        schema = {name: _field(name, values) for name, values in arrays.items()}
        writer = DatasetWriter.open(out, config=config, schema=schema, n=count, shard_size=SHARD_SIZE)
        for shard in writer.missing_shards():
            rows = writer.manifest.rows(shard)
            writer.write(shard, {name: values[rows.start : rows.stop] for name, values in arrays.items()})
        writer.finish()
    length = float(np.linalg.norm(np.diff(arrays["points"], axis=2), axis=-1).sum(-1).mean())
    links = the_task.scene.links
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    console.print(f"{count} trajectories of {states} states in {out}")
    console.print(
        f"their ropes are {length * links / (links - 1):.3g} m long, that of {task} "
        f"{the_task.scene.rope_part.parameters.length:.3g} m"
    )


def read_npz(file: Path) -> dict[str, np.ndarray]:
    """The arrays of a .npz file, those that an import knows.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no .npz, or has arrays of other names.
    """
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file}")
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:  # of damaged archives numpy raises anything
        raise ValueError(f"{file} is neither a .csv nor a .npz of arrays: {error}") from error
    unknown = sorted(set(arrays) - {*NEEDED, *OPTIONAL})
    if unknown:
        raise ValueError(f"{file} holds {', '.join(unknown)}: expected {', '.join((*NEEDED, *OPTIONAL))}")
    return arrays


def read_csv(file: Path) -> dict[str, np.ndarray]:
    """Points and grippers of a .csv file: see `import_trajectories`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a column is missing, a value is no number, or trajectories differ in length.
    """
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file}")
    lines = list(csv.reader(read_text(file).splitlines()))
    header = [name.strip() for name in lines[0]] if lines else []
    columns = {name: header.index(name) for name in header}
    counts = {
        kind: sum(name.startswith(kind) and name.endswith("_x") for name in header)
        for kind in ("point", "gripper")
    }
    wanted = [f"{kind}{i}_{axis}" for kind, count in counts.items() for i in range(count) for axis in AXES]
    missing = [name for name in ("trajectory", "step", *wanted) if name not in columns]
    if missing or not all(counts.values()):
        raise ValueError(
            f"{file} lacks the columns {', '.join(missing) or 'of points or grippers'}: expected trajectory, "
            "step, point0_x, point0_y, point0_z, ..., gripper0_x, ..."
        )
    found: dict[str, list[tuple[int, list[float]]]] = defaultdict(list)
    for number, line in enumerate(lines[1:], start=2):
        try:
            step, values = int(line[columns["step"]]), [float(line[columns[name]]) for name in wanted]
        except (ValueError, IndexError) as error:
            raise ValueError(f"{file}, line {number}: {error}") from error
        found[line[columns["trajectory"]]].append((step, values))
    rows = [np.array([values for _, values in sorted(states)]) for states in found.values()]
    lengths = sorted({len(row) for row in rows})
    if len(lengths) != 1:
        raise ValueError(f"{file} has trajectories of {lengths} states: expected one length, of at least 2")
    every = np.stack(rows).reshape(len(rows), lengths[0], -1, 3)
    return {"points": every[:, :, : counts["point"]], "grippers": every[:, :, counts["point"] :]}


def stored(task: Task, given: Mapping[str, np.ndarray], file: Path) -> dict[str, np.ndarray]:
    """All fields of the data set.

    Raises:
        ValueError: for what is missing, not finite, or of another shape than the task's.
    """
    absent = [name for name in NEEDED if name not in given]
    if absent:
        raise ValueError(f"{file} lacks {' and '.join(absent)}")
    links, hands = task.scene.links, task.grippers
    count, states = given["points"].shape[:2] if given["points"].ndim == 4 else (0, 0)
    if count < 1 or states < 2:
        shape = given["points"].shape
        raise ValueError(f"points has the shape {shape}, expected [K, T+1, {links}, 3] with T at least 1")
    shapes = {
        "points": (count, states, links, 3),
        "grippers": (count, states, hands, 3),
        "actions": (count, states - 1, hands, 3),
        "environment": (count,),
    }
    moves = np.diff(given["grippers"], axis=1)
    every: dict[str, Any] = {name: given[name] for name in NEEDED}
    every |= {"actions": moves, "environment": np.arange(count), **given, **_obstacles(task, given)}
    kinds = {"environment": np.int32, "obstacle_kind": np.int32, "obstacle_active": bool}
    for name, values in every.items():
        shape = shapes.get(name, (count, *values.shape[1:]))
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(
                f"{file}: {name} has the shape {list(values.shape)}"
                f"{'' if np.isfinite(values).all() else ' and values that are not finite'}, expected finite "
                f"numbers of the shape {list(shape)}, as of the task {task.name}"
            )
        every[name] = values.astype(kinds.get(name, np.float32))
    obstacles = Obstacles(**{name.removeprefix("obstacle_"): jnp.asarray(every[name]) for name in OBSTACLES})
    points, hands = jnp.asarray(every["points"]), jnp.asarray(every["grippers"])
    every["clearance"] = np.asarray(_clearance(task.scene, obstacles, points, hands))
    every["stretch"] = np.zeros((count, states), np.float32)
    every["faults"] = np.zeros((count, states - 1), np.int32)
    return every


def _obstacles(task: Task, given: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Those that are given, or as many inactive ones as the task has."""
    absent = [name for name in OBSTACLES if name not in given]
    if absent and len(absent) < len(OBSTACLES):
        raise ValueError(f"of the obstacles {', '.join(absent)} is missing: expected all of them, or none")
    if not absent:
        return {}
    count, most = len(given["points"]), max(sum(len(one.shapes) for one in task.scene.obstacles), 1)
    none = Obstacles(
        kind=jnp.zeros((count, most), jnp.int32),
        centre=jnp.zeros((count, most, 3)),
        quaternion=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count, most, 1)),
        half_size=jnp.ones((count, most, 3)),
        active=jnp.zeros((count, most), bool),
    )
    return {f"obstacle_{name}": np.asarray(values) for name, values in vars(none).items()}


@partial(jax.jit, static_argnums=0)
def _clearance(
    scene: Scene,
    obstacles: Obstacles,
    points: Float[Array, "K T1 N 3"],
    hands: Float[Array, "K T1 G 3"],
) -> Float[Array, "K T1"]:
    """Least distance (m) of the links' centres and of the hands to an obstacle."""

    def one(own: Obstacles, points: Array, hands: Array) -> Array:
        rope = signed_distance(own, points).min(-1) - scene.rope_part.parameters.radius
        radii = jnp.array([hand.radius for hand in scene.grippers])
        return jnp.minimum(rope, (signed_distance(own, hands) - radii).min(-1))

    return jax.vmap(one)(obstacles, points, hands)


def _field(name: str, values: np.ndarray) -> Field:
    units = {**STATES, "actions": ("m", "displacements of the hands"), "clearance": ("m", "to an obstacle")}
    unit, text = units.get(name, ("1", name.replace("_", " ")))
    return Field(values.shape[1:], values.dtype.name, unit, text)
