"""Figures in the prose of documents: each is a row of results, or said to be none; and the commands there.

A figure is written between two marks on its line, which a reader of the page does not see:

    <!-- row:AREA:METRIC tag=value tag=value -->97 %<!-- /row -->

METRIC may end in .low, .high or .n. `doojax report` writes the figure anew, with as many digits after the
point; its unit may be %, cm, mm or ms. What looks like a measured figure and is none, such as a definition,
stands between <!-- given --> and <!-- /given -->. In the lines of a table marks are filled in, too; what has
none there is not looked at.
"""

import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from doojax.commands import COMMANDS, parsed
from doojax.experiments.reports.rows import Row, Summary
from doojax.experiments.reports.summary import SUMMARY, read_summary

MARK = re.compile(r"<!-- row:([\w/-]+):(\w+)(?:\.(low|high|n))?((?: \w+=[^\s>]+)*) -->(.*?)<!-- /row -->")
GIVEN = re.compile(r"<!-- given -->.*?<!-- /given -->")
SHOWN = re.compile(r"(-?[\d,]+(?:\.(\d+))?)( ?)(%|cm|mm|ms|)")
SCALES = {"": (None, 1), "%": ("", 100), "cm": ("m", 100), "mm": ("m", 1000), "ms": ("s", 1000)}
COUNTS = "two|three|four|five|six|seven|eight|nine|ten|twenty"
MEASURED = re.compile(
    r"\d[\d.,]*\s?%"
    r"|\d[\d.,]* ?(?:ms|[µμ]s|cm|mm|seconds|minutes|hours|times)\b"
    rf"|\b(?:{COUNTS}) times\b"
    r"|\d[\d.,]* (?:\w+ ){0,3}(?:a|per) (?:second|minute)\b",
    re.IGNORECASE,
)
NOT_PROSE = re.compile(r"`[^`]*`|\]\([^)]*\)|<!--.*?-->")
INLINE = re.compile(r"`doojax ([^`]*)`")
FENCE, TABLES, TABLES_END = "```", "<!-- results:", "<!-- /results -->"


Read = Callable[[Path], Summary]


def with_figures(
    lines: Sequence[str], results: Path, document: Path, read: Read = read_summary
) -> Iterator[str]:
    """The lines of a document, with the marked figures of its prose as the rows have them.

    Args:
        lines: of the document.
        results: the folder of results.
        document: where it is, for errors.
        read: of a summary's file.

    Raises:
        ValueError: a mark has no row or no figure, or a figure has no mark; the message says where.
        FileNotFoundError: a mark's area has no summary.
    """
    fenced = tabled = False
    for number, line in enumerate(lines, start=1):
        fenced ^= line.lstrip().startswith(FENCE)
        tabled = (tabled or line.startswith(TABLES)) and line != TABLES_END
        if fenced or tabled:
            yield line
            continue
        where = f"{document}:{number}"
        try:
            new = MARK.sub(lambda mark: _written(mark, results, read), line)
        except (ValueError, FileNotFoundError) as error:
            raise type(error)(f"{where}: {error}") from error
        if line.startswith("|"):
            yield new
            continue
        prose = NOT_PROSE.sub(" ", GIVEN.sub(" ", MARK.sub(" ", new)))
        if "<!-- row" in GIVEN.sub(" ", MARK.sub(" ", new)):
            raise ValueError(
                f"{where}: a mark should read <!-- row:AREA:METRIC tag=value -->97 %<!-- /row -->"
            )
        found = MEASURED.search(prose)
        if found:
            raise ValueError(
                f"{where}: {found[0]!r} is in no row: put it between <!-- row:AREA:METRIC tag=value --> and "
                "<!-- /row -->, or, where nothing was measured, between <!-- given --> and <!-- /given -->"
            )
        yield new


def _written(mark: re.Match[str], results: Path, read: Read) -> str:
    """A mark with the figure that the row has."""
    area, metric, part, tags, old = mark.groups()
    wanted = dict(tag.split("=", 1) for tag in tags.split())
    row = the_row(read(results / area / SUMMARY).rows, metric, wanted)
    shown = SHOWN.fullmatch(old)
    if shown is None:
        raise ValueError(f"{old!r} should be a number, and after it %, cm, mm, ms or nothing")
    _, decimals, space, unit = shown.groups()
    expected, scale = SCALES[unit]
    if part != "n" and expected is not None and row.unit != expected:
        raise ValueError(f"{metric} is in {row.unit!r} and cannot be shown in {unit}")
    value = getattr(row, part or "value")
    if value is None:
        raise ValueError(f"{row.identity} has no {part}")
    head = mark.group(0)[: mark.group(0).index("-->") + 3]
    return f"{head}{value * scale:,.{len(decimals or '')}f}{space}{unit}<!-- /row -->"


def the_row(rows: Sequence[Row], metric: str, tags: dict[str, str]) -> Row:
    """The one row of a metric with just these tags, as texts.

    Raises:
        ValueError: there is none; the message says which there are.
    """
    own = [row for row in rows if row.metric == metric]
    found = [row for row in own if {name: str(tag) for name, tag in row.tags.items()} == tags]
    if len(found) == 1:
        return found[0]
    near = [row for row in own if tags.items() <= {name: str(tag) for name, tag in row.tags.items()}.items()]
    there = "; ".join(str(dict(row.tags)) for row in (near or own)[:5]) or "none of this metric"
    raise ValueError(f"no row is {metric} of {tags}; there are: {there}")


def commands_of(lines: Sequence[str]) -> Iterator[tuple[int, str]]:
    """Number of the line, and command, of every `doojax ...` in a document's code blocks."""
    fenced = False
    for number, line in enumerate(lines, start=1):
        fenced ^= line.lstrip().startswith(FENCE)
        text = line.strip().removeprefix("$ ")
        if fenced and text.startswith("doojax "):
            yield number, shlex.join(shlex.split(text, comments=True))


def command_faults(documents: Sequence[Path], results: Path, read: Read = read_summary) -> Iterator[str]:
    """What is wrong with the commands of documents and of results: those that `doojax` does not understand.

    A run with a note was recorded before commands were complete: its note says what is missing.
    """
    for document in documents:
        lines = document.read_text(encoding="utf-8").splitlines()
        for number, command in commands_of(lines):
            yield from _faults(command, f"{document}:{number}")
        for number, line in enumerate(lines, start=1):
            for mention in INLINE.findall(line):
                name = mention.split()[0]
                if name not in COMMANDS and re.fullmatch(r"[a-z][a-z-]*", name):
                    yield f"{document}:{number}: there is no command doojax {name}"
    for file in sorted(results.rglob(SUMMARY)):
        for run in read(file).runs:
            if not run.note:
                yield from _faults(run.command, str(file))


def _faults(command: str, where: str) -> Iterator[str]:
    try:
        parsed(command)
    except ValueError as error:
        yield f"{where}: {error}"
