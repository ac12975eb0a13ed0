"""Where the files of a data set are."""

from pathlib import Path

MANIFEST = "manifest.json"
RECORDS = "shards"  # the folder of the shards' records


def chunk_file(name: str, dimensions: int, shard: int) -> str:
    """Where zarr keeps a shard of a field with so many axes, relative to the data set's folder."""
    return f"{name}/c." + ".".join([str(shard), *"0" * (dimensions - 1)])


def record_file(shard: int) -> str:
    """Where a complete shard's record is, relative to the data set's folder."""
    return f"{RECORDS}/{shard:05d}.json"


def complete_shards(path: Path, shards: int) -> list[int]:
    """Those of the first ``shards`` shards that have a record, increasing."""
    names = {file.name: file.stem for file in (path / RECORDS).glob("*.json")}
    numbers = {int(stem): name for name, stem in names.items() if stem.isdecimal()}
    return sorted(n for n, name in numbers.items() if n < shards and record_file(n) == f"{RECORDS}/{name}")
