"""What a result was made by and from: digests of its inputs, and the commands that filled its folder."""

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

from doojax.datasets.files import MANIFEST
from doojax.experiments.reports.checks import check_run
from doojax.experiments.reports.machine import this_run
from doojax.experiments.reports.rows import Run
from doojax.files import append_line, file_digest
from doojax.learning.checkpoints import MODEL

COMMANDS = "commands.jsonl"
LETTERS = 16  # of a digest


def digest(path: Path) -> str:
    """The beginning of the SHA-256 of a file; of a data set's folder its manifest's, of a run's its model's.

    Raises:
        FileNotFoundError: there is no such file, or the folder holds neither.
    """
    if path.is_dir():
        for name in (MANIFEST, MODEL):
            if (path / name).exists():
                return file_digest(path / name)[:LETTERS]
        raise FileNotFoundError(f"{path} holds neither a data set nor a model")
    return file_digest(path)[:LETTERS]


def digests(paths: Mapping[str, Path | None]) -> dict[str, str]:
    """`digest` by name, of those inputs that there are."""
    return {name: digest(path) for name, path in paths.items() if path is not None}


def note_command(folder: Path, command: str, seed: int | None, inputs: Mapping[str, str]) -> None:
    """Note in a folder's commands.jsonl by which command, versions and device it was filled, once each."""
    if any((run.command, run.inputs) == (command, inputs) for run in noted_commands(folder)):
        return
    run = replace(this_run(), command=command, seed=seed, inputs=dict(inputs))
    append_line(folder / COMMANDS, json.dumps(asdict(run), ensure_ascii=False))


def noted_commands(folder: Path) -> list[Run]:
    """What `note_command` noted, oldest first; a last line that was cut off is left out.

    Raises:
        ValueError: another line is no note; the message says which.
    """
    file = folder / COMMANDS
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    runs = []
    for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
        try:
            item = json.loads(line)
            check_run(item)
        except ValueError as error:
            raise ValueError(f"{file}, line {number}: {error}; delete the line") from error
        runs.append(Run(**item))
    return runs
