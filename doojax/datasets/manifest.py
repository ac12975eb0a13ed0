"""What a data set's folder says about itself: its fields, its config and the versions that made it."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from doojax import __version__
from doojax.datasets.files import MANIFEST, RECORDS, describe_contents

FORMAT = "doojax dataset"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class Field:
    """One array of a data set, whose leading axis is the trajectory.

    Raises ValueError for a dtype that is not boolean, integer or floating point, or a size below 1.
    """

    shape: tuple[int, ...]  # of one trajectory; () for one number per trajectory
    dtype: str  # numpy's name: "float32", "int32", "bool"
    unit: str  # "m", "rad", "kg"; "1" where there is none
    description: str
    may_be_missing: bool = False  # NaN is allowed and means "no value"

    def __post_init__(self):
        """Refuse what cannot be stored."""
        if np.dtype(self.dtype).kind not in "biuf":
            raise ValueError(f"dtype must be boolean, integer or floating point, got {self.dtype!r}")
        if any(size < 1 for size in self.shape):
            raise ValueError(f"sizes must be at least 1, got {self.shape}: leave an empty field out")


@dataclass(frozen=True)
class Manifest:
    """The contents of manifest.json: equal for every run that would make the same bytes."""

    config: dict[str, Any]
    fields: dict[str, Field]
    trajectories: int
    shard_size: int
    versions: dict[str, str]

    @property
    def shards(self) -> int:
        """Number of shards, the last of which may be shorter."""
        return math.ceil(self.trajectories / self.shard_size)

    def rows(self, shard: int) -> range:
        """The trajectories that a shard holds."""
        return range(shard * self.shard_size, min((shard + 1) * self.shard_size, self.trajectories))

    def to_json(self) -> str:
        """The text of manifest.json."""
        content = {"format": FORMAT, "format_version": FORMAT_VERSION, "shards": self.shards, **asdict(self)}
        return json.dumps(content, indent=2, allow_nan=False) + "\n"


def make_manifest(
    config: Mapping[str, Any], fields: Mapping[str, Field], trajectories: int, shard_size: int
) -> Manifest:
    """A manifest for the installed versions of doojax, jax, mujoco and numpy.

    Raises ValueError for a config that JSON cannot hold, a field name that cannot name a folder, or counts
    below 1.
    """
    if trajectories < 1 or shard_size < 1:
        raise ValueError(
            f"counts must be at least 1, got {trajectories} trajectories in shards of {shard_size}"
        )
    for name in fields:
        if not name.isidentifier() or name == RECORDS:
            raise ValueError(f"a field's name must be an identifier other than {RECORDS!r}, got {name!r}")
    try:
        plain_config = json.loads(json.dumps(config, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"the config must hold only what JSON can: {error}") from error
    versions = {"doojax": __version__} | {name: version(name) for name in ("jax", "mujoco", "numpy")}
    return Manifest(plain_config, dict(fields), trajectories, shard_size, versions)


def read_manifest(path: Path) -> Manifest:
    """The manifest of the data set in folder ``path``.

    Raises FileNotFoundError where there is no folder, and ValueError where it holds no data set, a damaged
    manifest, or a newer format than this version reads.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is no data set at {path}: no such folder")
    if not path.is_dir():
        raise ValueError(f"{path} is not a data set: a file, where a folder was expected")
    file = path / MANIFEST
    if not file.exists():
        raise ValueError(f"{path} is not a data set: no {MANIFEST}; it holds {describe_contents(path)}")
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if content.get("format") != FORMAT:
            raise ValueError(f'"format" is {content.get("format")!r}, expected {FORMAT!r}')
        found = content["format_version"]
        if found == FORMAT_VERSION:
            fields = {
                name: Field(**{**field, "shape": tuple(field["shape"])})
                for name, field in content["fields"].items()
            }
            rest = ("config", "trajectories", "shard_size", "versions")
            return Manifest(fields=fields, **{key: content[key] for key in rest})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        problem = f"{type(error).__name__}: {error}"
        raise ValueError(f"{file} cannot be read as a data set's manifest ({problem})") from error
    raise ValueError(
        f"{path} has format version {found}, this doojax reads version {FORMAT_VERSION}: use a newer doojax"
    )


def differences(old: Manifest, new: Manifest) -> list[str]:
    """Lines "key: old -> new" for everything that differs, nested keys joined by dots."""
    before, after = _flat(json.loads(old.to_json())), _flat(json.loads(new.to_json()))
    return [
        f"{key}: {before.get(key, '(absent)')} -> {after.get(key, '(absent)')}"
        for key in {**before, **after}
        if before.get(key) != after.get(key)
    ]


def _flat(value: Any, prefix: str = "") -> dict[str, str]:
    if not isinstance(value, dict) or not value:
        return {prefix: json.dumps(value)}
    return {
        key: text
        for name, item in value.items()
        for key, text in _flat(item, f"{prefix}.{name}" if prefix else name).items()
    }
