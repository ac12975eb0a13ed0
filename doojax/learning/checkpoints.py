"""Models on disk: a line of JSON that says what to build, then the arrays; loading runs no code from it.

A model's file is named model.eqx by convention and may be moved or sent alone.
"""

import io
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree
from msgspec import Meta

from doojax.files import whole_file
from doojax.models.builders import BUILDERS
from doojax.reading import checked, parsed

FORMAT, FORMAT_VERSION = "doojax model", 1
MODEL = "model.eqx"
# What the figures in a header must be where they are there.
ABOUT: dict[str, Any] = {
    "threshold_m": Annotated[float, Meta(gt=0)],
    "preset": str,
    "seed": int,
    "labels": dict[str, Any],
    "conformal_thresholds": dict[str, float],
    "conformal_factors": dict[str, float],
}


@dataclass(frozen=True)
class Header:
    """What a model's file says before its arrays."""

    kind: str  # one of doojax.models.builders.BUILDERS
    task: str  # the name of the task whose data it learned from
    config: dict[str, Any]  # what it is built from
    about: dict[str, Any] = field(default_factory=dict)  # figures, seed, versions, models it was made with


def save_model(path: Path, header: Header, model: PyTree) -> None:
    """Write a model, whole or not at all.

    Raises:
        ValueError: for a kind that could not be loaded again.
    """
    build(header, path)
    text = {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(header), "arrays": shapes(model)}
    write_leaves(path, text, model)


def load_model(path: Path | str, *, task: str | None = None, kind: str | None = None) -> tuple[Any, Header]:
    """Read a model, in the session's precision (single, or double with ``jax_enable_x64``), and its header.

    Args:
        path: the file, or the folder of the run that made it.
        task: what task it must be for; any by default.
        kind: what kind it must be of, such as "dynamics"; any by default.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a model, is damaged, or is one of another kind or task.
    """
    path = Path(path)
    if path.is_dir():
        path = path / MODEL
    header, arrays = read_header(path)
    if kind is not None and header.kind != kind:
        raise ValueError(f"{path} is a model of kind {header.kind!r}, expected one of kind {kind!r}")
    if task is not None and header.task != task:
        raise ValueError(f"{path} was trained for the task {header.task!r}, not for {task!r}")
    # Built and read in the file's precision, whatever that of the session is.
    with jax.enable_x64(any("float64" in shape for shape in arrays.values())):
        model = _read_as_built(path, header, arrays)
    return jax.tree.map(
        lambda leaf: leaf.astype(float) if eqx.is_inexact_array(leaf) else leaf, model
    ), header


def _read_as_built(path: Path, header: Header, arrays: dict[str, str]) -> PyTree:
    like = build(header, path)
    expected = shapes(like)
    if arrays != expected:
        changed = [
            f"{name}: {arrays.get(name, 'absent')} in the file, {expected.get(name, 'absent')} in the model"
            for name in {**arrays, **expected}
            if arrays.get(name) != expected.get(name)
        ]
        raise ValueError(f"{path} does not fit the model that it names:\n  " + "\n  ".join(changed[:10]))
    return read_leaves(path, like)


def read_header(path: Path) -> tuple[Header, dict[str, str]]:
    """A file's header, and the shapes of its arrays by name. Errors as for `load_model`."""
    if not path.exists():
        raise FileNotFoundError(f"there is no model at {path}")
    text = read_json_line(path)
    if text is None or text.pop("format", None) != FORMAT:
        raise ValueError(f"{path} is not a model of doojax: its first line does not say so")
    version = text.pop("format_version", None)
    if version != FORMAT_VERSION:
        raise ValueError(
            f"{path} has format version {version!r}, this doojax reads {FORMAT_VERSION}: "
            "train it again, or use another doojax"
        )
    try:
        arrays = checked(text.pop("arrays", None), dict[str, str], "arrays")
        header = checked(text, Header)
        for name, kind in ABOUT.items():
            if name in header.about:
                checked(header.about[name], kind, name)
    except ValueError as error:
        raise ValueError(f"{path} has a damaged header: {error}") from error
    return header, arrays


def own_threshold(header: Header, path: Path) -> float:
    """The threshold (m) of the model error that was found when dynamics were trained.

    Raises ValueError where the model does not say.
    """
    if "threshold_m" not in header.about:
        raise ValueError(f"{path} does not say the threshold of its error (threshold_m): train it again")
    return float(header.about["threshold_m"])


def build(header: Header, path: Path) -> PyTree:
    """A model of the right structure whose arrays are shapes alone."""
    if header.kind not in BUILDERS:
        raise ValueError(
            f"{path}: unknown kind of model {header.kind!r}, expected one of {', '.join(BUILDERS)}"
        )
    make: Callable[[dict[str, Any]], PyTree] = BUILDERS[header.kind]
    try:
        return eqx.filter_eval_shape(make, header.config)
    except (ValueError, TypeError, OverflowError) as error:  # sizes that fit the schema, but not each other
        raise ValueError(f"{path}: no {header.kind} can be built from {header.config}: {error}") from error


def shapes(tree: PyTree) -> dict[str, str]:
    """Type and shape of every array and number of a pytree, by name."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {
        jax.tree_util.keystr(path).lstrip("."): f"{np.dtype(leaf.dtype)} {list(leaf.shape)}"
        for path, leaf in leaves
        if hasattr(leaf, "shape")
    }


def write_leaves(path: Path, header: dict[str, Any], tree: PyTree) -> None:
    """Write a line of JSON and a pytree's leaves to a file that is whole or absent."""
    leaves = io.BytesIO()  # numpy, writing to a real file, does not say why it cannot
    eqx.tree_serialise_leaves(leaves, tree)
    with whole_file(path) as file:
        file.write(json.dumps(header, allow_nan=False).encode() + b"\n")
        file.write(leaves.getbuffer())


def read_json_line(path: Path) -> dict[str, Any] | None:
    """The first line of a file, if it is a JSON object."""
    with path.open("rb") as file:
        try:
            text = parsed(file.readline(1_000_000))
        except ValueError:
            return None
    return text if isinstance(text, dict) else None


def read_leaves(path: Path, like: PyTree) -> PyTree:
    """The leaves behind a file's first line, in the structure of ``like``.

    Raises ValueError for a truncated or altered file.
    """
    sizes = [leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(like) if hasattr(leaf, "dtype")]
    if sum(sizes) > path.stat().st_size:
        raise ValueError(
            f"{path} is damaged: it has {path.stat().st_size} bytes, fewer than its arrays' {sum(sizes)}"
        )
    with path.open("rb") as file:
        file.readline()
        try:
            tree = eqx.tree_deserialise_leaves(file, like)
        except Exception as error:  # damaged bytes end anywhere in numpy
            raise ValueError(
                f"{path} is damaged: {(str(error) or type(error).__name__).splitlines()[0]}"
            ) from error
        if file.read(1):
            raise ValueError(f"{path} is damaged: there is more in it than the model's arrays")
    return tree
