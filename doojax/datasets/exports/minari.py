"""The folder that Minari (Farama Foundation) reads: one HDF5 file, and a JSON of its spaces.

Observations are a dictionary of the state's fields and the obstacles'. Random data have no goal, so rewards
are zero; an episode ends because it is cut off, never because something was reached.
"""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Shaped

from doojax.datasets.exports.episodes import Episodes

VERSION = "0.5.0"  # of Minari, the oldest whose layout this is: newer ones read it, too


def write_minari(episodes: Episodes, folder: Path, name: str) -> None:
    """Write a data set's episodes into an empty folder.

    Args:
        episodes: of any task.
        folder: exists; it is to be called ``name`` in the end.
        name: under which Minari finds it.
    """
    data = folder / "data"
    data.mkdir()
    arrays, steps = episodes.arrays, episodes.steps
    seen = (*episodes.states, *episodes.obstacles)
    with h5py.File(data / "main_data.hdf5", "w", libver="v110", track_order=True) as file:
        for number in range(len(episodes)):
            group = file.create_group(f"episode_{number}")
            group.attrs.update(
                id=number,
                total_steps=steps,
                split=episodes.split_of(number),
                trajectory=int(episodes.trajectory[number]),
                environment=int(episodes.environment[number]),
            )
            for field in seen:
                values = arrays[field][number]
                if field in episodes.obstacles:
                    values = np.broadcast_to(values, (steps + 1, *values.shape))
                _store(group, f"observations/{field}", values)
            _store(group, "actions", arrays["actions"][number])
            _store(group, "rewards", np.zeros(steps, np.float32))
            _store(group, "terminations", np.zeros(steps, bool))
            _store(group, "truncations", np.arange(steps) == steps - 1)
            _store(group, "infos/time_s", np.arange(steps + 1) * episodes.period)
            for field in episodes.measured:
                _store(group, f"infos/{field}", arrays[field][number])
            if "faults" in arrays:  # none at the start
                _store(group, "infos/faults", np.concatenate([[0], arrays["faults"][number]]))
    spaces = {field: box(arrays[field], varying=field in episodes.states) for field in seen}
    metadata = {
        "dataset_id": name,
        "minari_version": VERSION,
        "data_format": "hdf5",
        "total_episodes": len(episodes),
        "total_steps": len(episodes) * steps,
        "observation_space": json.dumps({"type": "Dict", "subspaces": spaces}),
        "action_space": json.dumps(box(arrays["actions"])),
        "algorithm_name": "random",
        "description": f"{episodes.text}; made by doojax. Rewards are zero: there is no goal.",
        "dataset_size": round((data / "main_data.hdf5").stat().st_size / 1e6, 1),
        "doojax": episodes.about(),
    }
    (data / "metadata.json").write_text(json.dumps(metadata, indent=2, allow_nan=False) + "\n")


def box(values: Shaped[np.ndarray, "K ..."], *, varying: bool = True) -> dict[str, Any]:
    """The space of one step of a field, without bounds where it is of floating point.

    Args:
        values: of all episodes, with an axis of steps after the first if ``varying``.
        varying: does it change from step to step?
    """
    shape, dtype = values.shape[1 + varying :], values.dtype
    if dtype.kind == "f":
        low, high = -np.inf, np.inf
    elif dtype.kind == "b":
        low, high = 0, 1
    else:
        low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
    bounds = {"low": np.full(shape, low).tolist(), "high": np.full(shape, high).tolist()}
    stored = "int8" if dtype.kind == "b" else dtype.name
    return {"type": "Box", "dtype": stored, "shape": list(shape), **bounds}


def _store(group: h5py.Group, name: str, values: Shaped[np.ndarray, "..."]) -> None:
    values = values.astype(np.int8) if name.startswith("observations/") and values.dtype == bool else values
    group.create_dataset(name, data=values, chunks=values.shape, compression="gzip", compression_opts=1)
