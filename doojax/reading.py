"""What comes from a file: read, and checked against a type before anything is done with it.

A type may be a dataclass, whose fields may be annotated with `msgspec.Meta` bounds and with jaxtyping's
shapes. Numbers are not taken for texts, booleans not for numbers.
"""

import dataclasses
import json
import re
import reprlib
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

NumberKind = Literal["float", "int", "bool"]

_PLACE = re.compile(r"\.([^.\[]+)|\[(\d+)\]")

MOST_SAID = 300  # characters of what another library found: it may quote the damaged bytes


def read_json[T](file: Path, kind: Callable[..., T], what: str) -> T:
    """The content of a JSON file (UTF-8, with or without a byte order mark).

    Args:
        file: to read.
        kind: what its content must be.
        what: the file is expected to be, for the message, such as "a data set's manifest".

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not JSON, or not of this kind; the message says where.
    """
    try:
        return checked(parsed(read_text(file)), kind)
    except ValueError as error:
        raise ValueError(f"{file} is not {what}: {error}") from error


def read_lines[T](file: Path, kind: Callable[..., T], what: str) -> list[T]:
    """What each line of a file holds as JSON; a last one that is still being written is left out.

    Errors as for `read_json`; none where the file is absent.
    """
    if not file.exists():
        return []
    found = []
    text = read_text(file)
    for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
        try:
            found.append(checked(parsed(line), kind))
        except ValueError as error:
            raise ValueError(f"{file}, line {number}, is not {what}: {error}") from error
    return found


def read_arrays(file: Path, what: str) -> tuple[Any, dict[str, np.ndarray]]:
    """The entry ``header`` of an .npz file, which is JSON, and its arrays. Nothing is unpickled.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no such file, or is damaged.
    """
    with _opened(file, what) as stored:
        arrays = {name: stored[name] for name in stored.files}
        return parsed(arrays.pop("header").tobytes()), arrays


def read_header(file: Path, what: str) -> Any:
    """The entry ``header`` of an .npz file alone; errors as for `read_arrays`."""
    with _opened(file, what) as stored:
        return parsed(stored["header"].tobytes())


@contextmanager
def _opened(file: Path, what: str) -> Iterator[np.lib.npyio.NpzFile]:
    if file.is_file() and not zipfile.is_zipfile(file):  # of which numpy would say that it may be unpickled
        raise ValueError(f"{file} is not {what} (it is no .npz archive)")
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            yield stored
    except (FileNotFoundError, IsADirectoryError, PermissionError):
        raise
    except Exception as error:  # damaged bytes end anywhere in zipfile, zlib and numpy
        problem = " ".join(f"{type(error).__name__}: {error}".splitlines())
        raise ValueError(f"{file} is not {what} ({problem[:MOST_SAID]})") from error


def require_arrays(
    arrays: Mapping[str, np.ndarray], expected: Mapping[str, tuple[NumberKind, tuple[int, ...]]]
) -> None:
    """Raise ValueError unless every array is there, with such numbers and such a shape."""
    for name, (kind, shape) in expected.items():
        values = arrays.get(name)
        if values is None:
            raise ValueError(f"{name} is absent, expected {kind} {shape}")
        if values.shape != shape or values.dtype.kind not in {"float": "f", "bool": "b", "int": "iu"}[kind]:
            raise ValueError(f"{name} is {values.dtype} {values.shape}, expected {kind} {shape}")


def read_text(file: Path) -> str:
    """A file's text.

    Raises ValueError where it is not UTF-8.
    """
    try:
        return file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is not text in UTF-8 (byte {error.start})") from error


def parsed(text: str | bytes) -> Any:
    """What JSON says. Raises ValueError where it is none."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def checked[T](value: object, kind: Callable[..., T], name: str = "") -> T:
    """``value`` as what it has to be: an object as a dataclass, a list as a tuple of numbers, and so on.

    Args:
        value: JSON values, and arrays in them.
        kind: what it must be.
        name: of the value, for the message.

    Raises:
        ValueError: it is not; the message says where, what is there, and what was expected.
    """
    before = f"{name}: " if name else ""
    unknown = sorted(_unknown(value, kind))
    if unknown:
        raise ValueError(f"{before}it has unknown {', '.join(unknown)}")
    try:
        return msgspec.convert(value, kind)
    except RecursionError:
        raise ValueError(f"{before}it is nested too deep") from None
    except msgspec.ValidationError as error:
        raise ValueError(before + _said(str(error), value)) from error


def _unknown(value: object, kind: Any) -> Iterator[str]:
    """Names that a dataclass, or one directly in it, lacks; msgspec would leave them out without a word."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind) and isinstance(value, dict):
        fields = {field.name: field.type for field in dataclasses.fields(kind)}
        yield from (str(name) for name in value if name not in fields)
        for name, inner in fields.items():
            yield from (f"{name}.{unknown}" for unknown in _unknown(value.get(name), inner))


def _said(text: str, value: Any) -> str:
    """msgspec's message in the words of this project, with the value that it is about."""
    text, _, place = text.partition(" - at `$")
    text = text.replace("`", "")
    text = re.sub(r"^Object missing required field (.*)", r"it lacks \1", text)
    place = place.rstrip("`").lstrip(".")
    if not place:
        return text[:1].lower() + text[1:]
    if not text.startswith("Expected") and not text.startswith("Invalid"):
        return f"{place}: {text}"
    found = value
    for key, index in _PLACE.findall("." + place):
        try:
            found = found[key] if key else found[int(index)]
        except (KeyError, IndexError, TypeError):
            return f"{place}: {text[:1].lower()}{text[1:]}"
    if "[...]" in place:
        return f"{place}: {text[:1].lower()}{text[1:]}"
    shown = f"{found.dtype} {found.shape}" if hasattr(found, "dtype") else reprlib.repr(found)
    return f"{place} is {shown}, {text[:1].lower()}{text[1:]}"
