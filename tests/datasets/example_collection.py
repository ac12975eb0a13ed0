"""A small collection whose shards depend on nothing but their number; run as a script, it collects."""

import hashlib
import sys
from pathlib import Path

import numpy as np

from doojax.datasets import DatasetWriter, Field

CONFIG = {"task": "example", "seed": 3, "rope": {"links": 4, "length": 0.5}}
PERIODS = 6
SCHEMA = {
    "points": Field((PERIODS + 1, 4, 3), "float32", "m", "points along the rope"),
    "grippers": Field((PERIODS + 1, 1, 3), "float32", "m", "gripper positions"),
    "actions": Field((PERIODS, 1, 3), "float32", "m", "gripper displacements"),
    "faults": Field((PERIODS,), "int32", "1", "bit set of faults"),
    "clearance": Field((PERIODS + 1,), "float32", "m", "distance to the nearest obstacle"),
    "stretch": Field((PERIODS + 1,), "float32", "1", "lengthening over length", may_be_missing=True),
    "obstacle_kind": Field((2,), "int32", "1", "shape"),
    "obstacle_centre": Field((2, 3), "float32", "m", "centre"),
    "obstacle_quaternion": Field((2, 4), "float32", "1", "body to world"),
    "obstacle_half_size": Field((2, 3), "float32", "m", "half size"),
    "obstacle_active": Field((2,), "bool", "1", "is it there"),
    "initial_qpos": Field((7,), "float64", "1", "generalised positions"),
    "environment": Field((), "int32", "1", "number of the scene"),
}


def open_writer(path, n=23, shard_size=5, config=CONFIG, schema=SCHEMA):
    return DatasetWriter.open(path, config=config, schema=schema, n=n, shard_size=shard_size)


def shard_arrays(writer, shard):
    """The values of a shard, drawn from a seed that is the SHA-256 of its number."""
    rows = writer.manifest.rows(shard)
    seed = hashlib.sha256(str(shard).encode()).digest()
    generator = np.random.default_rng(list(seed))
    arrays = {}
    for name, field in writer.manifest.fields.items():
        shape = (len(rows), *field.shape)
        dtype = np.dtype(field.dtype)
        if dtype.kind == "f":
            arrays[name] = generator.normal(size=shape).astype(dtype)
        else:
            arrays[name] = np.zeros(shape, dtype)
    if "obstacle_quaternion" in arrays:
        arrays["obstacle_quaternion"] /= np.linalg.norm(arrays["obstacle_quaternion"], axis=-1, keepdims=True)
    if "obstacle_active" in arrays:
        arrays["obstacle_active"] = generator.random(arrays["obstacle_active"].shape) < 0.7
    if "environment" in arrays:
        arrays["environment"] = (np.arange(rows.start, rows.stop) // 2).astype(np.int32)
    return arrays


def collect(path, shards=None, **options):
    """Write all missing shards, or only those given, and return the arrays of the whole collection."""
    writer = open_writer(path, **options)
    for shard in writer.missing_shards() if shards is None else shards:
        writer.write(shard, shard_arrays(writer, shard))
    if shards is None:
        writer.finish()
    every = [shard_arrays(writer, shard) for shard in range(writer.manifest.shards)]
    return {name: np.concatenate([arrays[name] for arrays in every]) for name in writer.manifest.fields}


def folder_bytes(path):
    return {
        str(file.relative_to(path)): file.read_bytes() for file in Path(path).rglob("*") if file.is_file()
    }


if __name__ == "__main__":
    writer = open_writer(sys.argv[1], n=120)
    print("ready", flush=True)
    for shard in writer.missing_shards():
        writer.write(shard, shard_arrays(writer, shard))
    writer.finish()
