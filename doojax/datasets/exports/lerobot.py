"""The folder that LeRobot (Hugging Face) reads, version 3.0 of its layout: Parquet tables and JSON.

A frame is a state and the action that was taken there, so that an episode has as many frames as actions;
where each action led, the last one included, stands beside it as next.observation.state.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from jaxtyping import Shaped

from doojax.datasets.exports.episodes import Episodes

VERSION = "v3.0"
FILES_IN_CHUNK, BYTES_IN_FILE = 1000, 100_000_000
PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)


class Column:
    """One feature: a vector, or a number where the size is one, of each frame."""

    def __init__(self, values: Shaped[np.ndarray, "K T D"], names: list[str], units: list[str]):
        """``values`` with the names and units of its D numbers."""
        self.values, self.names, self.units = values, names, units

    def about(self) -> dict[str, Any]:
        """What info.json says of it."""
        size = self.values.shape[-1]
        return {
            "dtype": self.values.dtype.name,
            "shape": [size],
            "names": self.names,
            "info": {"units": self.units},
        }

    def table(self, episodes: slice) -> pa.Array:
        """The frames of some episodes."""
        values = self.values[episodes]
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        return flat if values.shape[-1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[-1])


def write_lerobot(episodes: Episodes, folder: Path) -> None:
    """Write a data set's episodes into an empty folder.

    Args:
        episodes: of any task.
        folder: exists.
    """
    columns = columns_of(episodes)
    count, steps = len(episodes), episodes.steps
    each = sum(column.values[0].nbytes for column in columns.values())
    in_file = max(1, BYTES_IN_FILE // each)
    for number, start in enumerate(range(0, count, in_file)):
        some = slice(start, min(start + in_file, count))
        table = pa.table({name: column.table(some) for name, column in columns.items()})
        _write(table, folder / "data" / _place(number), rows=steps)
    _write(pa.Table.from_pylist(list(_episode_rows(episodes, columns, in_file))), _episodes_file(folder))
    _write(_tasks(episodes.text), folder / "meta/tasks.parquet")
    fps = 1 / episodes.period
    info = {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": count,
        "total_frames": count * steps,
        "total_tasks": 1,
        "chunks_size": FILES_IN_CHUNK,
        "data_files_size_in_mb": BYTES_IN_FILE // 1_000_000,
        "video_files_size_in_mb": 200,
        "fps": round(fps) if np.isclose(fps, round(fps), rtol=1e-9, atol=0) else fps,
        "splits": {name: f"{part.start}:{part.stop}" for name, part in episodes.splits.items()},
        "data_path": f"data/{PATH}",
        "video_path": None,
        "features": {name: column.about() for name, column in columns.items()},
    }
    stats = {name: statistics(column.values) for name, column in columns.items()}
    for name, content in (("info", info), ("stats", stats), ("doojax", episodes.about())):
        (folder / f"meta/{name}.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")


def columns_of(episodes: Episodes) -> dict[str, Column]:
    """The features of every frame, by LeRobot's names."""
    count, steps, arrays = len(episodes), episodes.steps, episodes.arrays
    joined = _joined(episodes, episodes.states)
    columns = {
        "observation.state": Column(joined.values[:, :-1], joined.names, joined.units),
        "action": _joined(episodes, ("actions",)),
        "next.observation.state": Column(joined.values[:, 1:], joined.names, joined.units),
    }
    if episodes.obstacles:
        once = _joined(episodes, episodes.obstacles)
        every = np.broadcast_to(once.values, (count, steps, once.values.shape[-1]))
        columns["observation.environment_state"] = Column(every, once.names, once.units)
    for name in episodes.measured:
        unit = episodes.dataset.fields[name].unit
        columns[f"observation.{name}"] = Column(arrays[name][:, :-1, None], [name], [unit])
        columns[f"next.observation.{name}"] = Column(arrays[name][:, 1:, None], [name], [unit])
    if "faults" in arrays:
        columns["next.faults"] = Column(arrays["faults"][..., None].astype(np.int64), ["faults"], ["1"])
    step, episode = np.broadcast_arrays(np.arange(steps), np.arange(count)[:, None])
    seconds = (step * episodes.period).astype(np.float32)
    for name, values, unit in (
        ("next.done", step == steps - 1, "1"),
        ("timestamp", seconds, "s"),
        ("frame_index", step, "1"),
        ("episode_index", episode, "1"),
        ("index", episode * steps + step, "1"),
        ("task_index", np.zeros_like(step), "1"),
    ):
        columns[name] = Column(values[..., None], [name], [unit])
    return columns


def statistics(values: Shaped[np.ndarray, "K T D"]) -> dict[str, list[Any]]:
    """Least, greatest, mean, deviation, number and quantiles over all frames, of each of D numbers."""
    flat = np.asarray(values.reshape(-1, values.shape[-1]), np.float64)
    found = {"min": flat.min(0), "max": flat.max(0), "mean": flat.mean(0), "std": flat.std(0)}
    levels = np.quantile(flat, QUANTILES, axis=0)
    found |= {f"q{round(100 * level):02d}": row for level, row in zip(QUANTILES, levels, strict=True)}
    return {name: row.tolist() for name, row in found.items()} | {"count": [len(flat)]}


def _joined(episodes: Episodes, names: tuple[str, ...]) -> Column:
    """Some fields as one vector a step; of what does not vary, as one step."""
    count, parts, coordinates, units = len(episodes), [], [], []
    for name in names:
        values = episodes.arrays[name]
        steps = 1 if name in episodes.obstacles else values.shape[1]
        parts.append(values.reshape(count, steps, -1).astype(np.float32))
        coordinates += episodes.coordinates(name)
        units += [episodes.dataset.fields[name].unit] * parts[-1].shape[-1]
    return Column(np.concatenate(parts, axis=-1), coordinates, units)


def _episode_rows(episodes: Episodes, columns: dict[str, Column], in_file: int) -> Iterator[dict[str, Any]]:
    steps = episodes.steps
    for number in range(len(episodes)):
        chunk, file = divmod(number // in_file, FILES_IN_CHUNK)
        row = {
            "episode_index": number,
            "tasks": [episodes.text],
            "length": steps,
            "dataset_from_index": number * steps,
            "dataset_to_index": (number + 1) * steps,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "split": episodes.split_of(number),
            "trajectory": int(episodes.trajectory[number]),
            "environment": int(episodes.environment[number]),
        }
        for name, column in columns.items():
            found = statistics(column.values[number : number + 1])
            row |= {f"stats/{name}/{figure}": values for figure, values in found.items()}
        yield row


def _tasks(text: str) -> pa.Table:
    """The only task, under an index of pandas, which is what readers look it up in."""
    string = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    number = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    about = {
        "index_columns": ["task"],
        "column_indexes": [{"name": None, "field_name": None, **string}],
        "columns": [
            {"name": "task_index", "field_name": "task_index", **number},
            {"name": "task", "field_name": "task", **string},
        ],
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": pa.array([text])})
    return table.replace_schema_metadata({"pandas": json.dumps(about)})


def _place(number: int) -> str:
    chunk, file = divmod(number, FILES_IN_CHUNK)
    return PATH.format(chunk_index=chunk, file_index=file)


def _episodes_file(folder: Path) -> Path:
    return folder / "meta/episodes" / _place(0)


def _write(table: pa.Table, file: Path, rows: int | None = None) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, file, compression="snappy", row_group_size=rows)
