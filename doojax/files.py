"""Files and folders: written whole or not at all, by one process at a time, begun anew or gone on with."""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from doojax.reading import read_json

TEMPORARY = ".partial"  # zarr's own ending, too, for a file that has not been renamed into place yet
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# What shared folders of virtual machines, and some network and FUSE mounts, answer to fsync of a folder.
NO_FSYNC = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.EBADF, errno.EACCES, errno.EPERM)


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """A file to write that takes the place of ``path`` once all of it is on the disk, or vanishes.

    Raises:
        OSError: it cannot be written; where the disk is full, the message says what to do.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY}")
    try:
        with room_explained(path):
            with temporary.open("wb") as file:
                yield file
            flush(temporary)
            temporary.replace(path)
            flush(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Replace a file's text so that a reader, or a crash, sees either the old or the new one."""
    with whole_file(path) as file:
        file.write(text.encode())


def append_line(file: Path, text: str) -> None:
    """Add a line to a file; one that a kill cut off is taken away first, or none after it could be read."""
    with room_explained(file.parent), file.open("a+b") as stream:
        if size := stream.seek(0, os.SEEK_END):
            stream.seek(size - 1)
            if stream.read(1) != b"\n":
                stream.seek(0)
                stream.truncate(stream.read().rfind(b"\n") + 1)
        stream.write(text.encode() + b"\n")


def flush(path: Path) -> None:
    """Have a file's bytes, or a folder's entries, reach the disk (fsync), where the file system can."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in NO_FSYNC or not path.is_dir():
            raise


@contextlib.contextmanager
def room_explained(path: Path, safe: str = "what was complete is safe") -> Iterator[None]:
    """Have the error of a full disk say where that was, what is safe, and what to do."""
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        text = f"no room left to write to {path}; {safe}: make room and run the same command again"
        raise OSError(error.errno, text) from error


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Have a folder to oneself, by a lock that dies with the process and leaves nothing behind.

    A folder that is absent is made; if nothing was put into it, it is taken away again. Where a file system
    has no locks, nobody is refused.

    Raises:
        BlockingIOError: another process, or another part of this one, works in it.
        ValueError: it is a file.
    """
    folder = Path(os.path.abspath(folder))
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: a new or empty folder was expected")
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    descriptor = _locked(folder)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # they hold something
            for path in made:
                path.rmdir()
        os.close(descriptor)


def _locked(folder: Path) -> int:
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            text = (
                f"{folder} is in use by another process: wait until that has ended, or choose another folder"
            )
            raise BlockingIOError(errno.EWOULDBLOCK, text) from None
        except OSError:  # no locks here
            return descriptor
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), folder.stat()):
                return descriptor
        os.close(descriptor)  # taken away between the two


def claim(
    folder: Path, name: str, content: Mapping[str, Any], what: str, *, leftovers: Collection[str] = ()
) -> None:
    """Begin a folder with ``content`` in the file ``name``, or return to one that was begun with it.

    Args:
        folder: absent, empty, or begun with the same content.
        name: of the JSON file that says what the folder is.
        content: all that determines what will be in the folder, as JSON values.
        what: the folder is to be, such as "run".
        leftovers: names that a process may have left there that was killed before it wrote ``name``.

    Raises:
        ValueError: the folder holds something else; the message says what, or what differs.
    """
    file = folder / name
    content = json.loads(json.dumps(content, allow_nan=False))
    if file.exists():
        changed = differences(read_json(file, dict[str, Any], f"the {name} of a folder of doojax"), content)
        if changed:
            raise ValueError(
                "\n  ".join([f"{folder} holds another {what} (old -> new):", *changed])
                + "\nchoose another folder, or the old settings to go on with it"
            )
    elif folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: a new or empty folder was expected")
    elif folder.exists() and any(not _left_over(item, leftovers) for item in folder.iterdir()):
        raise ValueError(
            f"{folder} holds no {what} but {describe_contents(folder)}: choose a new or empty folder"
        )
    else:
        write_whole(file, json.dumps(content, indent=2) + "\n")


def _left_over(item: Path, leftovers: Collection[str]) -> bool:
    return item.name.endswith(TEMPORARY) or item.name in leftovers


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Lines "key: old -> new" for every JSON value that differs, nested keys joined by dots."""
    before, after = _flat(old), _flat(new)
    return [
        f"{key}: {before.get(key, '(absent)')} -> {after.get(key, '(absent)')}"
        for key in {**before, **after}
        if before.get(key) != after.get(key)
    ]


def _flat(value: Any, prefix: str = "") -> dict[str, str]:
    if not isinstance(value, Mapping) or not value:
        return {prefix: json.dumps(value)}
    return {
        key: text
        for name, item in value.items()
        for key, text in _flat(item, f"{prefix}.{name}" if prefix else name).items()
    }


def describe_contents(path: Path) -> str:
    """The names in a folder, at most ten, for an error message."""
    names = sorted(item.name + "/" * item.is_dir() for item in path.iterdir())
    return (", ".join(names[:10]) + ", ..." * (len(names) > 10)) or "nothing"


def file_digest(file: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
