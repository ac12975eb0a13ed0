"""Writing a data set shard by shard: see doojax.datasets.store for the folder's layout."""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import ArrayLike
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.errors import ZarrUserWarning

from doojax.datasets.arrays import open_array
from doojax.datasets.files import MANIFEST, RECORDS, chunk_file, complete_shards, record_file
from doojax.datasets.manifest import Field, Manifest, make_manifest, read_manifest
from doojax.files import TEMPORARY, claim, file_digest, flush, room_explained, write_whole

SAFE = "complete shards are safe"


class DatasetWriter:
    """Writes a data set shard by shard, in any order; open one with `DatasetWriter.open`."""

    def __init__(self, path: Path, manifest: Manifest):
        """Use `DatasetWriter.open`."""
        self.path = path
        self.manifest = manifest
        self._arrays = {name: open_array(path, name, manifest, "r+") for name in manifest.fields}

    @classmethod
    def open(
        cls,
        path: Path | str,
        *,
        config: Mapping[str, Any],
        schema: Mapping[str, Field],
        n: int,
        shard_size: int = 64,
    ) -> "DatasetWriter":
        """Create a data set of ``n`` trajectories, or go on with one that was begun with the same arguments.

        Args:
            path: a folder that is absent, empty, or holds this very data set, perhaps unfinished.
            config: what made the data, seed included, as JSON values; readers get it back.
            schema: the fields by name.
            n: number of trajectories.
            shard_size: trajectories per shard; the last shard may hold fewer.

        Raises:
            ValueError: for a folder that holds something else, naming what differs; a config that JSON cannot
                hold; counts below 1.
            OSError: when the disk is full.
        """
        path = Path(path)
        manifest = make_manifest(config, schema, n, shard_size)
        if (path / MANIFEST).exists():
            read_manifest(path)  # whose errors say more
        with room_explained(path, SAFE):
            claim(path, MANIFEST, json.loads(manifest.to_json()), "data set")
            manifest = read_manifest(path)
            (path / RECORDS).mkdir(exist_ok=True)
            _create_arrays(path, manifest)
        return cls(path, manifest)

    def missing_shards(self) -> list[int]:
        """The shards that have still to be written."""
        shards = self.manifest.shards
        return sorted(set(range(shards)) - set(complete_shards(self.path, shards)))

    def write(self, shard: int, arrays: Mapping[str, ArrayLike]) -> None:
        """Write one shard; it counts once all of it is on the disk.

        Args:
            shard: its number, one of `missing_shards`.
            arrays: every field's values for the trajectories ``manifest.rows(shard)``, of exactly the
                field's dtype.

        Raises:
            ValueError: for a shard that does not exist or is complete, and for arrays that do not fit the
                fields or are not finite. Nothing has been written then.
            OSError: when the disk is full. The shards that were complete stay so.
        """
        if shard not in range(self.manifest.shards):
            raise ValueError(f"there is no shard {shard}: expected 0 to {self.manifest.shards - 1}")
        record = self.path / record_file(shard)
        if record.exists():
            raise ValueError(f"shard {shard} of {self.path} is complete already: write only missing_shards()")
        rows = self.manifest.rows(shard)
        checked = _fitting_arrays(shard, arrays, self.manifest.fields, len(rows))
        chunks = {}
        with room_explained(self.path, SAFE):
            for name, values in checked.items():
                file = self.path / chunk_file(name, values.ndim, shard)
                self._arrays[name][rows.start : rows.stop] = values
                chunks[name] = {"bytes": file.stat().st_size, "sha256": file_digest(file)}
                flush(file)
                flush(file.parent)
            content = {"shard": shard, "trajectories": len(rows), "chunks": chunks}
            write_whole(record, json.dumps(content, indent=1) + "\n")

    def finish(self) -> None:
        """Check that every shard is there and remove temporary files that killed runs left.

        Raises:
            ValueError: naming the shards that are missing.
        """
        missing = self.missing_shards()
        if missing:
            raise ValueError(
                f"{self.path} is unfinished: {len(missing)} of {self.manifest.shards} shards are missing, "
                f"the first is {missing[0]}"
            )
        for leftover in self.path.rglob(f"*{TEMPORARY}"):
            leftover.unlink()


def _create_arrays(path: Path, manifest: Manifest) -> None:
    try:
        group = zarr.open_group(path, mode="a", zarr_format=3, use_consolidated=False)
    except OSError:
        raise
    except Exception as error:  # damaged metadata end anywhere in zarr
        raise ValueError(f"{path / 'zarr.json'} cannot be read ({error}): delete it") from error
    for name, field in manifest.fields.items():
        if name not in group:
            group.create_array(
                name,
                shape=(manifest.trajectories, *field.shape),
                chunks=(manifest.shard_size, *field.shape),
                dtype=field.dtype,
                fill_value=0,
                compressors=[ZstdCodec(level=3), Crc32cCodec()],  # blosc's threads do not repeat their bytes
                chunk_key_encoding={"name": "default", "separator": "."},
                attributes={"unit": field.unit, "description": field.description},
            )
    with warnings.catch_warnings():
        # With its arrays listed in it, a reader of the group does not stumble over our own files beside them.
        warnings.simplefilter("ignore", ZarrUserWarning)
        zarr.consolidate_metadata(path)
    for file in [path / "zarr.json", *path.glob("*/zarr.json"), path]:
        flush(file)


def _fitting_arrays(
    shard: int, arrays: Mapping[str, ArrayLike], fields: Mapping[str, Field], count: int
) -> dict[str, np.ndarray]:
    if set(arrays) != set(fields):
        missing, unknown = sorted(set(fields) - set(arrays)), sorted(set(arrays) - set(fields))
        raise ValueError(f"shard {shard}: missing fields {missing}, unknown fields {unknown}")
    checked = {name: np.asarray(arrays[name]) for name in fields}
    for name, values in checked.items():
        field = fields[name]
        shape = (count, *field.shape)
        if values.shape != shape or values.dtype != field.dtype:
            raise ValueError(
                f"shard {shard}, field {name!r}: expected {field.dtype} {shape}, "
                f"got {values.dtype} {values.shape}"
            )
        if values.dtype.kind == "f":
            bad = np.isinf(values) if field.may_be_missing else ~np.isfinite(values)
            if bad.any():
                first = tuple(int(i) for i in np.argwhere(bad)[0])
                raise ValueError(
                    f"shard {shard}, field {name!r}: {int(bad.sum())} values are not finite, the first is "
                    f"{values[first]} at {first}; only NaN in a field that may be missing is allowed"
                )
    return checked
