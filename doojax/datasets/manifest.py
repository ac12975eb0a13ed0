"""What a data set's folder says about itself: its fields, its config and the versions that made it."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from doojax import __version__
from doojax.datasets.files import MANIFEST, RECORDS
from doojax.files import describe_contents
from doojax.reading import checked, read_json

FORMAT = "doojax dataset"
FORMAT_VERSION = 1
MOST_TRAJECTORIES = 100_000_000
MOST_SHARD_BYTES = 2**35  # a shard is held in memory, as numpy arrays and as JAX's


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
        try:
            kind = np.dtype(self.dtype).kind
        except TypeError:
            kind = ""
        if kind not in set("biuf"):
            raise ValueError(f"dtype must be boolean, integer or floating point, got {self.dtype!r}")
        if any(size < 1 for size in self.shape):
            raise ValueError(f"sizes must be at least 1, got {self.shape}: leave an empty field out")


@dataclass(frozen=True)
class Manifest:
    """The contents of manifest.json: equal for every run that would make the same bytes."""

    config: dict[str, Any]
    fields: Annotated[dict[str, Field], Meta(min_length=1)]
    trajectories: Annotated[int, Meta(ge=1, le=MOST_TRAJECTORIES)]
    shard_size: Annotated[int, Meta(ge=1)]
    versions: dict[str, str]

    def __post_init__(self):
        """Refuse names that are no folder's, and shards that no memory holds."""
        check_names(self.fields)
        each = sum(math.prod(field.shape) * np.dtype(field.dtype).itemsize for field in self.fields.values())
        size = each * min(self.shard_size, self.trajectories)
        if size > MOST_SHARD_BYTES:
            raise ValueError(
                f"a shard of {self.shard_size} trajectories has {size / 2**30:.3g} GiB, expected at most "
                f"{MOST_SHARD_BYTES / 2**30:.0f}: make trajectories shorter, or shards smaller"
            )

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
    if trajectories > MOST_TRAJECTORIES:
        raise ValueError(f"trajectories is {trajectories}, expected at most {MOST_TRAJECTORIES:,}")
    check_names(fields)
    try:
        plain_config = json.loads(json.dumps(config, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"the config must hold only what JSON can: {error}") from error
    versions = {"doojax": __version__} | {name: version(name) for name in ("jax", "mujoco", "numpy")}
    return Manifest(plain_config, dict(fields), trajectories, shard_size, versions)


def check_names(fields: Iterable[str]) -> None:
    """Raise ValueError for a field whose name could lead out of the data set's folder."""
    for name in fields:
        if not name.isidentifier() or name == RECORDS:
            raise ValueError(f"a field's name must be an identifier other than {RECORDS!r}, got {name!r}")


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
    what = "a data set's manifest"
    content = read_json(file, dict[str, Any], what)
    kind, found, shards = (content.pop(name, None) for name in ("format", "format_version", "shards"))
    if kind != FORMAT:
        raise ValueError(f'{file} is not {what}: "format" is {kind!r}, expected {FORMAT!r}')
    if found != FORMAT_VERSION:
        raise ValueError(
            f"{path} has format version {found!r}, this doojax reads version {FORMAT_VERSION}: use a newer "
            "doojax"
        )
    try:
        manifest = checked(content, Manifest)
        if shards != manifest.shards:
            raise ValueError(f"shards is {shards!r}, but the counts make {manifest.shards}")
        return manifest
    except ValueError as error:
        raise ValueError(f"{file} is not {what}: {error}") from error
