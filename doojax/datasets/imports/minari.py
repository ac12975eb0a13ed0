"""Minari's folder read: one HDF5 file and a JSON about it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Shaped

from doojax.datasets.imports.recorded import About, Recorded, about_of, once, one_length
from doojax.datasets.imports.trajectories import NEEDED, OBSTACLES
from doojax.files import describe_contents
from doojax.reading import read_json

MEASURED = ("clearance", "stretch")
OLDEST = (0, 5)  # version of Minari whose layout this is


def read_minari(folder: Path) -> Recorded:
    """What a data set of Minari holds.

    Raises:
        FileNotFoundError: there is no such folder.
        ValueError: it is none of Minari's, of another layout, damaged, or its parts do not fit together.
    """
    data = folder / "data"
    about, file = data / "metadata.json", data / "main_data.hdf5"
    if not folder.exists():
        raise FileNotFoundError(f"there is no folder {folder}")
    if not about.is_file():
        held = describe_contents(folder) if folder.is_dir() else "no folder"
        raise ValueError(f"{folder} is no data set of Minari: it has no data/metadata.json, but {held}")
    metadata = read_json(about, dict[str, Any], "Minari's metadata")
    _require_layout(metadata, about)
    if not file.is_file():
        raise ValueError(f"{folder} lacks data/main_data.hdf5, which holds the numbers")
    own = about_of(metadata["doojax"], about) if "doojax" in metadata else None
    try:
        with h5py.File(file) as stored:
            return _read(stored, metadata, own, folder)
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error}") from error


def _require_layout(metadata: dict[str, Any], file: Path) -> None:
    layout, version = metadata.get("data_format", "hdf5"), str(metadata.get("minari_version", ""))
    if layout != "hdf5":
        raise ValueError(f"{file} says that data_format is {layout!r}: expected 'hdf5'")
    numbers = [int(part) for part in version.lstrip("~=>").split(".")[:2] if part.isdigit()]
    if tuple(numbers) < OLDEST:
        raise ValueError(f"{file} is of Minari {version or 'of no version'}: expected 0.5 or newer")


def _read(stored: h5py.File, metadata: dict[str, Any], own: About | None, folder: Path) -> Recorded:
    count = len(stored)
    if count != metadata.get("total_episodes", count):
        raise ValueError(f"{folder} says that it has {metadata['total_episodes']} episodes, and has {count}")
    groups: list[Any] = [stored.get(f"episode_{number}") for number in range(count)]
    if absent := [number for number, group in enumerate(groups) if not isinstance(group, h5py.Group)]:
        raise ValueError(f"{folder} has {count} episodes, but no episode_{absent[0]}")
    steps = one_length({n: len(_array(group, "actions", folder)) for n, group in enumerate(groups)}, folder)
    if count * steps != metadata.get("total_steps", count * steps):
        raise ValueError(
            f"{folder} says that it has {metadata['total_steps']} steps, and has {count} episodes of {steps}"
        )
    numbered = own is not None or all("trajectory" in group.attrs for group in groups)
    order = np.argsort([group.attrs["trajectory"] for group in groups]) if numbered else np.arange(count)
    groups = [groups[number] for number in order]
    wanted = (
        [name for name in own.fields if name != "environment"]
        if own
        else [*NEEDED, *_given(groups), "actions"]
    )
    arrays = {name: _stacked(name, groups, steps, folder) for name in wanted}
    expected = {name: own.fields[name].shape for name in wanted} if own else {}
    for name, shape in expected.items():
        if (found := arrays[name].shape[1:]) != shape:
            raise ValueError(f"{folder}: {name} has the shape {found}, expected {shape}")
    if all("environment" in group.attrs for group in groups):
        arrays["environment"] = np.array([group.attrs["environment"] for group in groups], np.int32)
    splits = [str(group.attrs.get("split", "")) for group in groups] if own else []
    return Recorded(arrays, own, splits)


def _given(groups: list[h5py.Group]) -> Iterator[str]:
    """The obstacles' fields, where an episode of others has them."""
    return (name for name in OBSTACLES if f"observations/{name}" in groups[0])


def _stacked(name: str, groups: list[h5py.Group], steps: int, folder: Path) -> Shaped[np.ndarray, "K ..."]:
    """A field of all episodes."""
    place = {"actions": "actions", "faults": "infos/faults"} | {one: f"infos/{one}" for one in MEASURED}
    expected = steps if name == "actions" else steps + 1
    parts = []
    for group in groups:
        values = _array(group, place.get(name, f"observations/{name}"), folder)
        if len(values) != expected or (parts and values.shape != parts[0].shape):
            shape = parts[0].shape if parts else (expected, ...)
            raise ValueError(
                f"{folder}: {name} of {str(group.name)[1:]} has the shape {values.shape}, not {shape}"
            )
        parts.append(values)
    every = np.stack(parts)
    if name in OBSTACLES:
        return once(name, every, folder)
    return every[:, 1:] if name == "faults" else every  # those before the first step are none


def _array(group: h5py.Group, name: str, folder: Path) -> Shaped[np.ndarray, "..."]:
    found = group.get(name)
    if isinstance(found, h5py.Dataset):
        return found[:]
    raise ValueError(
        f"{folder}: {str(group.name)[1:]} has no {name}; expected actions, and observations that are a "
        "dictionary of points [T+1, N, 3] and grippers [T+1, G, 3]"
    )
