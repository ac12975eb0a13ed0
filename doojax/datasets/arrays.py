"""The zarr array of a field, which has to be what the manifest says."""

from pathlib import Path
from typing import Literal

import zarr
from zarr.core.array_spec import ArrayConfigParams

from doojax.datasets.files import MANIFEST
from doojax.datasets.manifest import Manifest


def open_array(path: Path, name: str, manifest: Manifest, mode: Literal["r", "r+"] = "r") -> zarr.Array:
    """The array of field ``name`` in the data set's folder ``path``; a chunk that is missing is an error.

    Raises ValueError where it cannot be read, or differs from the manifest.
    """
    field = manifest.fields[name]
    each = field.shape
    wanted = f"{field.dtype} {(manifest.trajectories, *each)} in chunks {(manifest.shard_size, *each)}"
    try:
        config: ArrayConfigParams = {"read_missing_chunks": False, "write_empty_chunks": True}
        array = zarr.open_array(path / name, mode=mode, config=config)
        found = f"{array.dtype} {array.shape} in chunks {array.chunks}"
        if found != wanted:
            raise ValueError(f"{found}, not {wanted} as in {MANIFEST}")
    except Exception as error:  # damaged metadata end anywhere in zarr
        raise ValueError(
            f"field {name!r}: {path / name / 'zarr.json'} cannot be read: {error}\n"
            "to make it anew, delete it and run the same collect command again"
        ) from error
    return array
