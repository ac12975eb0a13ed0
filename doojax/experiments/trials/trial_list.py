"""One line a trial: what lists of thousands show without opening a record."""

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.why import why
from doojax.files import append_line
from doojax.reading import read_lines

LIST = "trials.jsonl"
KEEP = "the search's tree was not kept: doojax evaluate --keep-trees records all that was tried"
Count = Annotated[int, Meta(ge=0)]


@dataclass(frozen=True)
class TrialLine:
    """What a list says of one trial."""

    trial: Count  # the number of its scene
    reached: bool
    why: str
    error_m: float | None  # at the end; None where it is not known
    searches: Count
    actions: Count
    recoveries: Count
    plan_s: float


DECODER = msgspec.json.Decoder(TrialLine)


def line_of(record: TrialRecord, trial: int) -> TrialLine:
    """The line of a trial."""
    about = record.about
    error = about.get("final_error_m")
    return TrialLine(
        trial=trial,
        reached=record.reached,
        why=why(record),
        error_m=None if error is None else float(error),
        searches=int(about.get("searches", len(record.plans))),
        actions=int(about.get("actions", len(record.points) - 1)),
        recoveries=int(about.get("recovery_actions", 0)),
        plan_s=float(about.get("plan_s", 0.0)),
    )


def note_trial(folder: Path, line: TrialLine) -> None:
    """Append a trial to the list in a method's folder."""
    append_line(folder / LIST, json.dumps(asdict(line), allow_nan=False))


def list_trials(folder: Path) -> Iterator[TrialLine]:
    """The trials whose records are in a method's folder, by number: as listed, or read from the record.

    Reading records takes milliseconds each; what is listed comes at once. Of two lines the later counts.

    Raises:
        ValueError: a list or a record is damaged; the message names it.
    """
    listed = {line.trial: line for line in _lines(folder / LIST)}
    with os.scandir(folder) as entries:
        names = (os.path.splitext(entry.name) for entry in entries)
        numbers = sorted(int(stem) for stem, ending in names if ending == ".npz" and stem.isdecimal())
    for number in numbers:
        if number in listed:
            yield listed[number]
            continue
        file = folder / f"{number:05d}.npz"
        record = load_record(file)
        if not isinstance(record, TrialRecord):
            raise ValueError(f"{file} is a record of something else, expected a trial: delete it")
        yield line_of(record, number)


def _lines(file: Path) -> list[TrialLine]:
    """All whole lines of a list at once: one after another, ten thousand would take seconds."""
    try:
        text = file.read_bytes()
        return DECODER.decode_lines(text[: text.rfind(b"\n") + 1])
    except FileNotFoundError:
        return []
    except msgspec.MsgspecError:
        return read_lines(file, TrialLine, "a list of trials")  # which says where, and what is wrong
