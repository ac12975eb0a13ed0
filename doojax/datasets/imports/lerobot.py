"""LeRobot's folder read: numbers in Parquet tables, found by the names that meta/info.json gives them."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from jaxtyping import Shaped

from doojax.datasets.exports.episodes import ONE, coordinates
from doojax.datasets.exports.lerobot import VERSION
from doojax.datasets.imports.recorded import About, Recorded, about_of, once, one_length
from doojax.datasets.imports.trajectories import NEEDED, OBSTACLES
from doojax.files import describe_contents
from doojax.reading import read_json

NEXT = "next."
COUNTS = ("episode_index", "frame_index")
OBSTACLE_SIZES = dict(zip(OBSTACLES, (("1",), ("m", 3), ("1", 4), ("m", 3), ("1",)), strict=True))


class Frames:
    """All frames of K episodes of T steps, in order."""

    def __init__(self, folder: Path, features: dict[str, Any], table: pa.Table):
        """Order the frames. Raises ValueError where they are not whole episodes of one length."""
        self.folder, self.features, self.table = folder, features, table
        episode, frame = (self._numbers(name) for name in COUNTS)
        found, lengths = np.unique(episode, return_counts=True)
        self.steps = one_length(dict(zip(found.tolist(), lengths.tolist(), strict=True)), folder)
        self.count = len(found)
        self._order = np.lexsort((frame, episode))
        if not np.array_equal(frame[self._order], np.tile(np.arange(self.steps), self.count)):
            raise ValueError(f"{folder}: frame_index does not count the frames of every episode from 0")
        self._place = {name: place for key in features for name, place in self._names(key)}

    def has(self, name: str) -> bool:
        """Is a number of this name there? Names of where an action led begin with `NEXT`."""
        return name in self._place

    def many(self, before: str, after: str = "") -> int:
        """How many names there are such as ``before`` 0 ``after``, ``before`` 1 ``after``, ..."""
        return next(i for i in itertools.count() if f"{before}{i}{after}" not in self._place)

    def numbers(self, names: list[str]) -> Shaped[np.ndarray, "K T D"]:
        """Numbers by their names.

        Raises:
            ValueError: for one that no feature has.
        """
        absent = [name for name in names if name not in self._place]
        if absent:
            raise ValueError(
                f"{self.folder} has no {', '.join(absent[:5])}{', ...' if len(absent) > 5 else ''} among the "
                "names of its features in meta/info.json; expected point0_x, point0_y, point0_z, ..., "
                "gripper0_x, ..."
            )
        needed = {self._place[name][0] for name in names}
        columns = {key: self._numbers(key)[self._order] for key in needed}
        picked = [columns[key][:, at] for key, at in (self._place[name] for name in names)]
        return np.stack(picked, axis=-1).reshape(self.count, self.steps, len(names))

    def _names(self, key: str) -> list[tuple[str, tuple[str, int]]]:
        """The names of a feature's numbers, with their places."""
        names = self.features[key].get("names") if isinstance(self.features[key], dict) else None
        while isinstance(names, dict) and len(names) == 1:  # as in {"axes": [...]}
            (names,) = names.values()
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            return []
        before = NEXT if key.startswith(NEXT) else ""
        return [(before + name, (key, at)) for at, name in enumerate(names)]

    def _numbers(self, key: str) -> Shaped[np.ndarray, "n ..."]:
        """A column, [n, D] for a feature."""
        if key not in self.table.column_names:
            raise ValueError(f"{self.folder}: the files below data lack the column {key}")
        column = self.table[key].combine_chunks()
        if column.null_count:
            raise ValueError(f"{self.folder}: {key} has {column.null_count} frames without a value")
        listed = pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)
        values = np.asarray(column.flatten() if listed else column)
        if values.dtype.kind not in "biuf":
            raise ValueError(f"{self.folder}: {key} holds {column.type}, expected numbers")
        if key in COUNTS:
            return values
        size = max(len(self._names(key)), 1)
        if values.size != size * len(column):
            raise ValueError(
                f"{self.folder}: {key} has {values.size} numbers in {len(column)} frames, but {size} names"
            )
        return values.reshape(len(column), size)


def read_lerobot(folder: Path) -> Recorded:
    """What a data set of LeRobot, layout 3.0, holds.

    Raises:
        FileNotFoundError: there is no such folder.
        ValueError: it is none of LeRobot's, of another layout, damaged, or its parts do not fit together.
    """
    if not folder.exists():
        raise FileNotFoundError(f"there is no folder {folder}")
    file = folder / "meta/info.json"
    if not file.is_file():
        held = describe_contents(folder) if folder.is_dir() else "no folder"
        raise ValueError(f"{folder} is no data set of LeRobot: it has no meta/info.json, but {held}")
    info = read_json(file, dict[str, Any], "LeRobot's info.json")
    if info.get("codebase_version") != VERSION:
        layout = info.get("codebase_version")
        raise ValueError(f"{folder} has LeRobot's layout {layout!r}, expected {VERSION!r}: convert it first")
    features = info.get("features")
    if not isinstance(features, dict):
        raise ValueError(f"{file} lists no features")
    frames = Frames(folder, features, _tables(folder, "data"))
    for name, found in (("episodes", frames.count), ("frames", frames.count * frames.steps)):
        if info.get(f"total_{name}", found) != found:
            raise ValueError(f"{folder} says that it has {info[f'total_{name}']} {name}, and has {found}")
    beside = folder / "meta/doojax.json"
    if not beside.is_file():
        return Recorded(_foreign(frames), None, [])
    own = about_of(read_json(beside, dict[str, Any], "what doojax wrote"), beside)
    return _exported(frames, own, _tables(folder, "meta/episodes"))


def _exported(frames: Frames, own: About, episodes: pa.Table) -> Recorded:
    """All fields that doojax exported, in the order that the data set had."""
    told = {name: episodes[name].to_pylist() for name in episodes.column_names if "stats" not in name}
    absent = [name for name in ("trajectory", "environment", "split", "length") if name not in told]
    if absent or len(episodes) != frames.count or set(told["length"]) != {frames.steps}:
        problem = f"lack {', '.join(absent)}" if absent else "count other episodes or frames than there are"
        raise ValueError(f"{frames.folder}: the files below meta/episodes {problem}")
    order = np.argsort(told["trajectory"])
    arrays = {"environment": np.array(told["environment"], np.int32)[order]}
    for name, field in own.fields.items():
        if name in arrays:
            continue
        names = list(field.coordinates)
        if name in ("actions", "faults"):
            values = frames.numbers(names if name == "actions" else [NEXT + one for one in names])
        elif name in OBSTACLES:
            values = once(name, frames.numbers(names), frames.folder)
        else:
            values = _states(frames, names)
        size = (frames.count, *field.shape)
        if values.size != np.prod(size):
            raise ValueError(
                f"{frames.folder}: {name} has {len(names)} names, which do not make {field.shape}"
            )
        arrays[name] = values.reshape(size)[order]
    return Recorded(arrays, own, [told["split"][number] for number in order])


def _foreign(frames: Frames) -> dict[str, Shaped[np.ndarray, "K ..."]]:
    """What others recorded, by the names of its numbers."""
    arrays: dict[str, np.ndarray] = {}
    for name in NEEDED:
        names = coordinates(name, (max(frames.many(ONE[name], "_x"), 1), 3), "m")
        values = _states(frames, names)
        arrays[name] = values.reshape(*values.shape[:2], -1, 3)
    if hands := frames.many(ONE["actions"], "_x"):
        values = frames.numbers(coordinates("actions", (hands, 3), "m"))[:, : arrays["points"].shape[1] - 1]
        arrays["actions"] = values.reshape(*values.shape[:2], -1, 3)
    if most := frames.many(OBSTACLES[0]):
        for name, (unit, *size) in OBSTACLE_SIZES.items():
            values = once(name, frames.numbers(coordinates(name, (most, *size), unit)), frames.folder)
            arrays[name] = values.reshape(len(values), most, *size)
    return arrays


def _states(frames: Frames, names: list[str]) -> Shaped[np.ndarray, "K T1 D"]:
    """States [K, T+1, D] where it is said where the last action led; [K, T, D] where not.

    Raises:
        ValueError: the next state is another than that of the next frame.
    """
    seen = frames.numbers(names)
    if not all(frames.has(NEXT + name) for name in names):
        return seen
    led = frames.numbers([NEXT + name for name in names])
    if (differs := seen[:, 1:] != led[:, :-1]).any():
        number, step = np.argwhere(differs.any(-1))[0]
        raise ValueError(
            f"{frames.folder}: frame {step} of episode {number} led elsewhere than where frame {step + 1} is"
        )
    return np.concatenate([seen, led[:, -1:]], axis=1)


def _tables(folder: Path, below: str) -> pa.Table:
    files = sorted((folder / below).glob("*/*.parquet"))
    if not files:
        raise ValueError(f"{folder} has no Parquet file below {below}")
    try:
        return pa.concat_tables([parquet.ParquetFile(file).read() for file in files])
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"a Parquet file below {folder / below} cannot be read: {error}") from error
