"""Data sets on disk: one zarr group of arrays whose leading axis is the trajectory.

The folder, which plain `zarr.open(folder)` reads too::

    manifest.json           config, fields, counts, versions: see doojax.datasets.manifest
    zarr.json               the zarr v3 group, with the metadata of all its arrays
    points/zarr.json        one array per field ...
    points/c.12.0.0.0       ... with one chunk file per shard of trajectories
    shards/00012.json       the record of shard 12: size and SHA-256 of each of its chunk files

A shard is complete when its record exists. The record is written last: chunk files reach the disk first
(fsync), then the record is written to a temporary file, flushed and renamed into place. Whatever a killed run
or a power cut leaves behind has no record, is not shown to readers, and is written anew when the collection
resumes. No file holds a date, a host or anything else that differs between runs, so a resumed collection has
the bytes of an uninterrupted one.
"""

import dataclasses
import warnings
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import zarr
from jaxtyping import Int, Key
from numpy.typing import DTypeLike

from doojax.datasets.arrays import open_array
from doojax.datasets.files import chunk_file, complete_shards, record_file
from doojax.datasets.manifest import Field, Manifest, read_manifest
from doojax.datasets.splits import split_by_environment
from doojax.datasets.states import state_names
from doojax.files import file_digest
from doojax.reading import read_json
from doojax.types import Obstacles, RopeState, Trajectory

Indices = int | np.integer | slice | Sequence[int] | np.ndarray | jax.Array  # of trajectories


@dataclasses.dataclass(frozen=True)
class Chunk:
    """What a shard's record says about one of its files."""

    bytes: int
    sha256: str


@dataclasses.dataclass(frozen=True)
class ShardRecord:
    """The record of a complete shard."""

    shard: int
    trajectories: int
    chunks: dict[str, Chunk]  # by field


class StoredField:
    """One field of a data set: behaves like a numpy array that is read from disk when indexed."""

    def __init__(self, dataset: "Dataset", name: str):
        """Use ``dataset[name]``."""
        self._dataset = dataset
        self._name = name
        self.field = dataset.fields[name]
        self.shape = (len(dataset), *self.field.shape)
        self.dtype = np.dtype(self.field.dtype)

    def __len__(self) -> int:
        """Number of trajectories."""
        return self.shape[0]

    def __repr__(self) -> str:
        """Name, type, shape, unit and meaning."""
        return f"{self._name}: {self.dtype} {list(self.shape)}, {self.field.unit}: {self.field.description}"

    def __getitem__(self, index: Indices) -> np.ndarray:
        """Trajectories as numpy would index the leading axis; reads only the shards that are needed.

        Raises:
            IndexError: outside of the data set, or for an index into the other axes.
            ValueError: for a damaged or missing chunk file, naming it.
        """
        if isinstance(index, tuple):
            raise IndexError(
                "only trajectories can be indexed: index the resulting array for the other axes, "
                f"as in dataset[{self._name!r}][:10][:, 0]"
            )
        if not isinstance(index, slice):
            index = np.asarray(index)
            index = index if index.size else index.astype(int)
        self._dataset.zarr_array(self._name)  # before room is made for what it holds
        rows = self._dataset.rows[index]
        return self._read(rows.ravel()).reshape(rows.shape + self.field.shape)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        """All of it, for `numpy.asarray`."""
        return self[:].astype(self.dtype if dtype is None else dtype, copy=False)

    def _read(self, rows: np.ndarray) -> np.ndarray:
        values = np.empty((len(rows), *self.field.shape), self.dtype)
        shards = rows // self._dataset.manifest.shard_size
        order = np.argsort(shards)
        for selected in np.split(order, np.flatnonzero(np.diff(shards[order])) + 1):
            if selected.size:
                shard = int(shards[selected[0]])
                chunk = self._dataset.read_shard(shard, [self._name])[self._name]
                values[selected] = chunk[rows[selected] - shard * self._dataset.manifest.shard_size]
        return values


class Dataset:
    """A data set on disk; open one with `Dataset.open`. ``dataset["points"][10:20]`` is a numpy array.

    Attributes:
        path: its folder.
        manifest: config, fields, counts and versions.
        shards: numbers of the complete shards; only their trajectories are shown.
    """

    def __init__(self, path: Path, manifest: Manifest, shards: Sequence[int]):
        """Use `Dataset.open`."""
        self.path = path
        self.manifest = manifest
        self.shards = list(shards)
        self._arrays: dict[str, zarr.Array] = {}

    @classmethod
    def open(cls, path: Path | str) -> "Dataset":
        """Open a data set for reading; an unfinished one opens with its complete shards and a warning.

        Raises:
            FileNotFoundError: where there is no folder.
            ValueError: where it holds no data set, or one of a newer format.
        """
        path = Path(path)
        manifest = read_manifest(path)
        dataset = cls(path, manifest, complete_shards(path, manifest.shards))
        if not dataset.complete:
            warnings.warn(
                f"{path} is unfinished: {len(dataset)} of {dataset.manifest.trajectories} trajectories; "
                "the same collect command resumes it",
                stacklevel=2,
            )
        return dataset

    @property
    def fields(self) -> dict[str, Field]:
        """The fields by name."""
        return self.manifest.fields

    @property
    def config(self) -> dict[str, Any]:
        """The config that the data were made with."""
        return self.manifest.config

    @cached_property
    def rows(self) -> Int[np.ndarray, "n"]:
        """Number of each shown trajectory within the whole collection; range(n) when complete."""
        parts = (np.arange(rows.start, rows.stop) for rows in map(self.manifest.rows, self.shards))
        return np.concatenate([np.arange(0), *parts])

    @property
    def complete(self) -> bool:
        """Whether every shard has been written."""
        return len(self.shards) == self.manifest.shards

    def __len__(self) -> int:
        """Number of trajectories in complete shards."""
        return sum(len(self.manifest.rows(shard)) for shard in self.shards)

    def __repr__(self) -> str:
        """Folder, size and fields."""
        state = "" if self.complete else f" of {self.manifest.trajectories}, unfinished"
        return f"Dataset({str(self.path)!r}: {len(self)} trajectories{state}; {', '.join(self.fields)})"

    def __getitem__(self, name: str) -> StoredField:
        """A field by name. Raises KeyError naming the fields that exist."""
        if name not in self.fields:
            raise KeyError(f"{self.path} has no field {name!r}, only {', '.join(self.fields)}")
        return StoredField(self, name)

    def read_shard(self, shard: int, fields: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """All trajectories of a complete shard, for all fields or those named.

        Raises ValueError for a damaged or missing chunk file, naming it.
        """
        rows = self.manifest.rows(shard)
        values = {}
        for name in self.fields if fields is None else fields:
            array = self.zarr_array(name)
            try:
                values[name] = np.asarray(array[rows.start : rows.stop])
            except Exception as error:  # damaged bytes end anywhere in zarr's codecs
                place = f"shard {shard}, field {name!r}: {self._chunk_file(shard, name)}"
                raise ValueError(f"{place} cannot be read: {error}\n{self._repair([shard])}") from error
        return values

    def verify(self) -> None:
        """Check each array's metadata and compare every chunk file with its checksum.

        Raises ValueError naming shard, field and file of everything missing, truncated or altered.
        """
        for name in self.fields:
            self.zarr_array(name)
        problems = {shard: list(self._shard_problems(shard)) for shard in self.shards}
        bad = [shard for shard, found in problems.items() if found]
        if bad:
            lines = [line for found in problems.values() for line in found]
            more = [f"... and {len(lines) - 10} more"] if len(lines) > 10 else []
            raise ValueError("\n".join([*lines[:10], *more, self._repair(bad)]))

    def batches(
        self,
        batch_size: int,
        fields: Sequence[str],
        *,
        key: Key[jax.Array, ""] | None = None,
        indices: Sequence[int] | np.ndarray | jax.Array | None = None,
    ) -> Iterator[dict[str, np.ndarray]]:
        """One pass over the trajectories, as dicts of arrays [batch_size, ...]; the last may be shorter.

        The chosen trajectories' fields are held in memory during the pass.

        Args:
            batch_size: trajectories per batch.
            fields: names of the fields wanted.
            key: shuffles; the order depends on nothing but the key and the number of trajectories. None
                keeps the stored order.
            indices: the trajectories wanted, such as ``dataset.split("train")``; all by default.

        Raises:
            ValueError: for a batch size below 1.
            KeyError: for an unknown field.
        """
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        chosen = np.arange(len(self)) if indices is None else np.asarray(indices)
        if key is not None:
            chosen = chosen[np.asarray(jax.random.permutation(key, len(chosen)))]
        values = {name: self[name][chosen] for name in fields}
        return (
            {name: array[start : start + batch_size] for name, array in values.items()}
            for start in range(0, len(chosen), batch_size)
        )

    def split(self, name: str) -> np.ndarray:
        """Indices of the "train" (70 %), "validation", "calibration" or "test" trajectories (10 % each).

        Trajectories of one scene (field ``environment``; without it, each is its own) share a split: see
        `doojax.datasets.splits.split_by_environment`.

        Raises:
            ValueError: for another name, for an unfinished data set, whose splits would change as it grows,
                and where there are too few scenes for a split to hold any.
        """
        if not self.complete:
            raise ValueError(f"{self.path} is unfinished and has no splits yet: resume its collection first")
        environment = self["environment"][:] if "environment" in self.fields else self.rows
        splits = split_by_environment(environment)
        if name not in splits:
            raise ValueError(f"there is no split {name!r}, only {', '.join(splits)}")
        if not len(splits[name]):
            scenes = len(np.unique(environment))
            raise ValueError(f"the {name} split is empty: {scenes} scenes are too few, collect 10 or more")
        return splits[name]

    def states(self, indices: Indices, kind: type[Any] | None = None) -> Any:
        """States [k, T+1] of a type whose fields are the data set's; by default that of `doojax.types`."""
        kind = state_names(self.fields)[0] if kind is None else kind
        names = [one.name for one in dataclasses.fields(kind)]
        return kind(**{name: jnp.asarray(self[name][indices]) for name in names})

    def obstacles(self, indices: Indices) -> Obstacles:
        """The obstacles [k, M] of each trajectory's scene."""
        names = ("kind", "centre", "quaternion", "half_size", "active")
        return Obstacles(**{name: jnp.asarray(self[f"obstacle_{name}"][indices]) for name in names})

    def trajectories(self, indices: Indices, kind: type[Any] = RopeState) -> Trajectory:
        """Each trajectory's states, of the type named, and all else that a `Trajectory` holds."""
        names = [one.name for one in dataclasses.fields(Trajectory) if one.name != "states"]
        stored = {name: jnp.asarray(self[name][indices]) for name in names if name in self.fields}
        stored.setdefault("stretch", jnp.zeros_like(stored["clearance"]))  # where there is no rope
        return Trajectory(states=self.states(indices, kind), **stored)

    def zarr_array(self, name: str) -> zarr.Array:
        """The array that holds a field. Raises ValueError where it is not as the manifest says."""
        if name not in self._arrays:
            self._arrays[name] = open_array(self.path, name, self.manifest)
        return self._arrays[name]

    def _shard_problems(self, shard: int) -> Iterator[str]:
        try:
            record = read_json(self.path / record_file(shard), ShardRecord, "a shard's record")
            expected = record.chunks
            if expected.keys() != self.fields.keys():
                raise ValueError(f"it has the fields {', '.join(expected)}")
        except (OSError, ValueError) as error:
            yield f"shard {shard}: its record {self.path / record_file(shard)} cannot be read ({error!r})"
            return
        for name, chunk in expected.items():
            file = self._chunk_file(shard, name)
            place = f"shard {shard}, field {name!r}: {file}"
            if not file.exists():
                yield f"{place} is missing"
            elif file.stat().st_size != chunk.bytes:
                yield f"{place} has {file.stat().st_size} bytes instead of {chunk.bytes}"
            elif file_digest(file) != chunk.sha256:
                yield f"{place} has been altered: its SHA-256 differs"

    def _chunk_file(self, shard: int, name: str) -> Path:
        return self.path / chunk_file(name, 1 + len(self.fields[name].shape), shard)

    def _repair(self, shards: Sequence[int]) -> str:
        files = ", ".join(str(self.path / record_file(shard)) for shard in shards[:10])
        more = ", ..." * (len(shards) > 10)
        return f"to make them anew, delete {files}{more} and run the same collect command again"
