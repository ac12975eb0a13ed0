"""Records on disk: one file each, read by the viewer and by anyone else.

A file is an ``.npz``: numpy arrays, and in its entry ``header`` UTF-8 JSON with everything else::

    {"format": "doojax trial", "version": 1, "task": "rope_dragging", "points": {"array": "points"}, ...}

An object {"array": NAME} stands for the array of that name. Nothing is pickled.
"""

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from doojax.experiments.trials.records import PredictionRecord, Record, TrialRecord
from doojax.files import whole_file
from doojax.reading import checked, read_arrays

VERSION = 1


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
