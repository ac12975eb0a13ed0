"""What others recorded, or doojax exported, as a data set to learn from: `doojax import`."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from doojax.datasets.imports.files import read_csv, read_npz
from doojax.datasets.imports.recorded import About, Recorded
from doojax.datasets.imports.trajectories import OBSTACLES, field_of, stored
from doojax.datasets.manifest import Field
from doojax.datasets.splits import split_by_environment
from doojax.datasets.writer import DatasetWriter
from doojax.files import alone_in, file_digest
from doojax.optional import require
from doojax.tasks import make_task
from doojax.tasks.base import Phase
from doojax.types import RopeState

SHARD_SIZE = 64
Layout = Literal["lerobot", "minari"]
NEEDS = {"lerobot": "pyarrow", "minari": "h5py"}


def import_trajectories(
    source: Path,
    /,
    *,
    format: Layout | None = None,
    task: str | None = None,
    phase: Phase | None = None,
    out: Path,
) -> None:
    """Make a data set of trajectories that were recorded elsewhere, in metres, for doojax train.

    A .npz holds the arrays points [K, T+1, N, 3] (the centres of the rope's links) and grippers
    [K, T+1, G, 3]; if it has them, also actions [K, T, G, 3] (displacements that were commanded; by default
    those that were made), environment [K] (trajectories with one number share a scene, and so a split) and
    obstacle_kind, obstacle_centre, obstacle_quaternion, obstacle_half_size and obstacle_active [K, M, ...]
    (see doojax.types.Obstacles; by default there are none).

    A .csv has a line for each state: trajectory, step, point0_x, point0_y, point0_z, ..., gripper0_x, ...

    A folder of LeRobot (layout 3.0) has these names of the .csv among those of its features; a folder of
    Minari has the arrays of the .npz in its observations. What doojax exported comes back as it was, but for
    what only a replay needs.

    Args:
        source: the .npz, the .csv or the folder.
        format: of a folder: lerobot or minari.
        task: whose rope and hands they are of; what doojax exported says so itself.
        phase: unconstrained (nothing in the way; the default) or constrained; then the obstacles must be
            there. What doojax exported says so itself.
        out: the data set's folder; new or empty.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ModuleNotFoundError: a folder is to be read, and the extra export is not installed.
        ValueError: for what does not fit the task, is not finite, disagrees or is missing; the message says
            what.
    """
    found = _read(source, format)
    if found.about is not None:
        config, schema, arrays = _as_it_was(source, found.about, found.arrays, task, phase)
    else:
        config, schema, arrays = _of_others(source, found.arrays, task, phase or "unconstrained")
    given: dict[str, Any] = {"file": source.name, "sha256": _digest(source)} | (
        {"format": format} if format else {}
    )
    if found.about is not None:
        given["versions"] = found.about.versions
    config["imported"] = given
    config.setdefault("stream", f"import/{given['sha256'][:16]}")
    count, states = len(arrays["actions"]), arrays["actions"].shape[1] + 1
    with alone_in(out):
        writer = DatasetWriter.open(out, config=config, schema=schema, n=count, shard_size=SHARD_SIZE)
        for shard in writer.missing_shards():
            rows = writer.manifest.rows(shard)
            writer.write(shard, {name: values[rows.start : rows.stop] for name, values in arrays.items()})
        writer.finish()
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    console.print(f"{count} trajectories of {states} states in {out}")
    for line in _words(found, arrays, config["task"]):
        console.print(line)


def _read(source: Path, format: Layout | None) -> Recorded:
    if format is None:
        if source.is_dir():
            raise ValueError(f"{source} is a folder: say --format lerobot or --format minari")
        return Recorded(read_csv(source) if source.suffix == ".csv" else read_npz(source), None, [])
    require(NEEDS[format])
    if format == "minari":
        from doojax.datasets.imports.minari import read_minari

        return read_minari(source)
    from doojax.datasets.imports.lerobot import read_lerobot

    return read_lerobot(source)


type Contents = tuple[dict[str, Any], dict[str, Field], dict[str, np.ndarray]]


def _as_it_was(
    source: Path, about: About, arrays: Mapping[str, np.ndarray], task: str | None, phase: Phase | None
) -> Contents:
    """Config, fields and arrays of a data set that doojax exported."""
    for name, wanted in (("task", task), ("phase", phase)):
        held = about.config.get(name)
        if not isinstance(held, str) or wanted not in (None, held):
            raise ValueError(f"{source} has data of the {name} {held!r}, not {wanted!r}: leave --{name} out")
    fields = {name: field.plain for name, field in about.fields.items()}
    if "environment" not in fields:  # trajectories were scenes of their own
        fields["environment"] = field_of("environment", arrays["environment"])
    typed = {name: arrays[name].astype(field.dtype) for name, field in fields.items()}
    for name, values in typed.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{source}: {name} has values that are not finite")
    return dict(about.config), fields, typed


def _of_others(source: Path, given: Mapping[str, np.ndarray], task: str | None, phase: Phase) -> Contents:
    """Config, fields and arrays of what others recorded of a task."""
    if task is None:
        raise ValueError(f"{source} does not say what its rope and hands are: say --task")
    the_task = make_task(task, phase=phase)
    if not isinstance(the_task.blank, RopeState):
        raise ValueError(f"states of {task} are not of a rope and hands alone: it has no import")
    if phase == "constrained" and OBSTACLES[0] not in given:
        raise ValueError(f"{source} has no obstacles, which phase constrained needs: {', '.join(OBSTACLES)}")
    arrays = stored(the_task, given, source)
    config = {
        "task": task,
        "seed": 0,
        "scene": the_task.scene.digest,
        "phase": phase,
        "states": arrays["points"].shape[1],
    }
    return config, {name: field_of(name, values) for name, values in arrays.items()}, arrays


def _words(found: Recorded, arrays: Mapping[str, np.ndarray], task: str) -> list[str]:
    """What else a user should know."""
    if found.about is None:
        scene = make_task(task).scene
        length = float(np.linalg.norm(np.diff(arrays["points"], axis=2), axis=-1).sum(-1).mean())
        whole = length * scene.links / (scene.links - 1)
        own = scene.rope_part.parameters.length
        return [f"their ropes are {whole:.3g} m long, that of {task} {own:.3g} m"]
    lines = []
    if found.about.left_out:
        lines.append(f"not exported, and so not here: {', '.join(found.about.left_out)} (for doojax replay)")
    if missing := found.about.left_out_without_values:
        now = split_by_environment(arrays["environment"])
        moved = sum(found.splits[row] != name for name, rows in now.items() for row in rows)
        lines.append(
            f"trajectories without values were not exported: {missing}; without them {moved} others are in "
            "another split than before"
        )
    return lines


def _digest(source: Path) -> str:
    """Of a file, or of all files of a folder."""
    if source.is_file():
        return file_digest(source)
    total = hashlib.sha256()
    for file in sorted(path for path in source.rglob("*") if path.is_file()):
        total.update(f"{file.relative_to(source).as_posix()} {file_digest(file)}\n".encode())
    return total.hexdigest()
