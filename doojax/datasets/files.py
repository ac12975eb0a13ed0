"""Where the files of a data set are, and how they reach the disk whole."""

import hashlib
import os
from pathlib import Path

MANIFEST = "manifest.json"
RECORDS = "shards"  # the folder of the shards' records
TEMPORARY = ".partial"  # zarr's own ending for a file that has not been renamed into place yet


def chunk_file(name: str, dimensions: int, shard: int) -> str:
    """Where zarr keeps a shard of a field with so many axes, relative to the data set's folder."""
    return f"{name}/c." + ".".join([str(shard), *"0" * (dimensions - 1)])


def record_file(shard: int) -> str:
    """Where a complete shard's record is, relative to the data set's folder."""
    return f"{RECORDS}/{shard:05d}.json"


def complete_shards(path: Path, shards: int) -> list[int]:
    """Those of the first ``shards`` shards that have a record, increasing."""
    recorded = {file.name for file in (path / RECORDS).glob("*.json")}
    return [shard for shard in range(shards) if Path(record_file(shard)).name in recorded]


def describe_contents(path: Path) -> str:
    """The names in a folder, at most ten, for an error message."""
    names = sorted(item.name + "/" * item.is_dir() for item in path.iterdir())
    return (", ".join(names[:10]) + ", ..." * (len(names) > 10)) or "nothing"


def write_atomically(file: Path, text: str) -> None:
    """Write a file that is either whole and on the disk, or absent, whenever the process ends."""
    temporary = file.with_name(f"{file.name}.{os.getpid()}{TEMPORARY}")
    temporary.write_text(text, encoding="utf-8")
    flush(temporary)
    temporary.replace(file)
    flush(file.parent)


def flush(path: Path) -> None:
    """Have a file's bytes, or a folder's entries, reach the disk (fsync)."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def file_digest(file: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
