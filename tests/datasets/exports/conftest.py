"""A data set whose every number is known: episodes of three steps, one of which became unstable."""

import numpy as np
import pytest

from doojax.datasets import Dataset, DatasetWriter, Field

K, T, N, M = 11, 3, 5, 2  # the toy's rope, and two obstacles
UNSTABLE = 4
STATE = {"points": ("m", (T + 1, N, 3)), "grippers": ("m", (T + 1, 1, 3))}
REST = {
    "actions": ("m", (T, 1, 3)),
    "clearance": ("m", (T + 1,)),
    "obstacle_kind": ("1", (M,)),
    "obstacle_centre": ("m", (M, 3)),
    "obstacle_quaternion": ("1", (M, 4)),
    "obstacle_half_size": ("m", (M, 3)),
    "obstacle_active": ("1", (M,)),
    "faults": ("1", (T,)),
    "initial_qpos": ("m, rad", (2,)),
    "environment": ("1", ()),
}
TYPES = {"obstacle_kind": "int32", "obstacle_active": "bool", "faults": "int32", "environment": "int32"}


def numbers() -> dict[str, np.ndarray]:
    """Trajectory k, step t, number i of a field: 1000 k + 10 t + i / 100, but for small integers."""
    arrays = {}
    for name, (_, shape) in (STATE | REST).items():
        k, *rest = np.indices((K, *shape))
        t = rest[0] if shape[:1] in ((T,), (T + 1,)) else 0
        i = np.arange(int(np.prod(shape))).reshape(shape) % int(np.prod(shape[1:]) or 1)
        arrays[name] = (1000 * k + 10 * t + i / 100).astype(TYPES.get(name, "float32"))
    arrays["faults"] = np.tile(np.array([0, 0, 4], np.int32), (K, 1))
    arrays["obstacle_kind"] = np.tile(np.array([0, 2], np.int32), (K, 1))
    arrays["obstacle_active"] = np.tile([True, False], (K, 1))
    arrays["environment"] = np.arange(K, dtype=np.int32)
    arrays["points"][UNSTABLE, 2:] = np.nan
    return arrays


@pytest.fixture(scope="package")
def known():
    return numbers()


@pytest.fixture(scope="package")
def folder(tmp_path_factory, known):
    path = tmp_path_factory.mktemp("data") / "known"
    schema = {
        name: Field(shape, TYPES.get(name, "float32"), unit, name, may_be_missing=name in STATE)
        for name, (unit, shape) in (STATE | REST).items()
    }
    config = {"task": "toy", "phase": "constrained", "seed": 0}
    writer = DatasetWriter.open(path, config=config, schema=schema, n=K, shard_size=4)
    for shard in writer.missing_shards():
        rows = writer.manifest.rows(shard)
        writer.write(shard, {name: values[rows.start : rows.stop] for name, values in known.items()})
    writer.finish()
    return path


@pytest.fixture(scope="package")
def dataset(folder):
    return Dataset.open(folder)
