"""The tables of README.md and docs/*.md, made from results/<area>/summary.json and never typed.

A table stands between two lines of a document, each alone on its line:

    <!-- results:AREA:METRIC[,METRIC] -->
    <!-- /results -->

Its first columns are the tags under which the metrics were measured, its last ones the metrics; below it
stands how the figures were made. Figures in prose are those of rows, too: see `prose`.
"""

import os
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

from doojax.experiments.reports.prose import Read, command_faults, with_figures
from doojax.experiments.reports.rows import Row, Summary
from doojax.experiments.reports.summary import read_summary
from doojax.files import write_whole

OPENING = re.compile(r"<!-- results:([\w/-]+):(\w+(?:,\w+)*) -->")
CLOSING = "<!-- /results -->"


def report(path: Path = Path("results"), /, *, readme: Path | None = None, check: bool = False) -> None:
    """Write the tables and figures of README.md and docs/*.md anew from the summary files.

    Args:
        path: the folder of results, RESULTS/<area>/summary.json; the documents lie beside it.
        readme: only this document, wherever it lies.
        check: change nothing; fail if a table or a figure is not what the summary files say, or a command in
            the documents or the summary files is not understood.

    Raises:
        FileNotFoundError: the folder, a document or a summary that a table needs is not there.
        ValueError: a marker is malformed or its metric is unknown, a figure in prose is in no row, or `check`
            found something stale or a command that is not understood.
    """
    if not path.is_dir():
        raise FileNotFoundError(
            f"there is no folder of results {path}; name it, as in: doojax report results"
        )
    beside = path.resolve().parent
    documents = [readme] if readme else [beside / "README.md", *sorted(beside.glob("docs/*.md"))]
    documents = [document for document in documents if readme or document.exists()]
    stale, read = [], cache(read_summary)  # for as long as this call takes
    for document in documents:
        old = document.read_text(encoding="utf-8")
        tables = list(filled(old.splitlines(), path, document, read))
        new = "".join(f"{line}\n" for line in with_figures(tables, path, document, read))
        if new != old:
            stale.append(document.name)
            if not check:
                write_whole(document, new)
    if stale and check:
        raise ValueError(
            f"the tables or figures of {', '.join(stale)} are stale; to write them anew, run: doojax report"
        )
    faults = list(command_faults(documents, path, read)) if check else []
    if faults:
        raise ValueError("\n".join(["some commands are not understood:", *faults]))
    print(f"tables written anew: {', '.join(stale)}" if stale else "every table is up to date")


def filled(lines: Sequence[str], results: Path, document: Path, read: Read) -> Iterator[str]:
    """The lines of a document, with the tables between its markers made anew."""
    opened = 0  # number of the line that opened the current table, if there is one
    for number, line in enumerate(lines, start=1):
        where = f"{document}:{number}"
        if line.startswith("<!-- results"):
            marker = OPENING.fullmatch(line)
            if marker is None:
                raise ValueError(f"{where}: {line!r} should read <!-- results:AREA:METRIC[,METRIC] -->")
            if opened:
                raise ValueError(f"{where}: the table of line {opened} is not closed; add {CLOSING}")
            opened = number
            area, metrics = marker.groups()
            file = results / area / "summary.json"
            link = os.path.relpath(file.resolve(), document.resolve().parent)
            try:
                new = table(read(file), metrics.split(","), link)
            except (ValueError, FileNotFoundError) as error:
                raise type(error)(f"{where}: {error}") from error
            yield from (line, *new)
        elif line == CLOSING:
            if not opened:
                raise ValueError(f"{where}: {CLOSING} closes no table")
            opened = 0
            yield line
        elif not opened:
            yield line
    if opened:
        raise ValueError(f"{document}:{opened}: this table is not closed; add {CLOSING} below it")


def table(summary: Summary, metrics: Sequence[str], link: str) -> list[str]:
    """Lines of Markdown: the rows of some metrics, and how they were measured.

    Args:
        summary: where the rows come from.
        metrics: one column each, in this order.
        link: from the document to the summary's file.

    Raises:
        ValueError: the summary has no row of one of the metrics.
    """
    units = {row.metric: row.unit for row in summary.rows}
    for metric in metrics:
        if metric not in units:
            raise ValueError(f"{link} has no metric {metric!r}; it has: {', '.join(units)}")
    chosen = [row for row in summary.rows if row.metric in metrics]
    names = list(dict.fromkeys(name for row in chosen for name in row.tags))
    heads = [f"{metric} ({units[metric]})" if units[metric] else metric for metric in metrics]
    lines = [cells([*names, *heads]), cells([*(":--" for _ in names), *("--:" for _ in heads)])]

    figures: dict[tuple[str, ...], dict[str, str]] = {}
    for row in chosen:
        tags = tuple(str(row.tags.get(name, "")) for name in names)
        figures.setdefault(tags, {})[row.metric] = figure(row)
    for tags, values in figures.items():
        lines.append(cells([*tags, *(values.get(metric, "") for metric in metrics)]))

    lines.append("")
    for index in sorted({row.run for row in chosen}):
        run = summary.runs[index]
        seed = "" if run.seed is None else f", seed {run.seed}"
        note = f" ({run.note})" if run.note else ""
        lines.append(
            f"- `{run.command}`{note}{seed}, {run.date[:10]}, {run.device} ([figures and versions]({link}))"
        )
    return lines


def cells(texts: Sequence[str]) -> str:
    """One line of a Markdown table."""
    return f"| {' | '.join(text.replace('|', chr(92) + '|') for text in texts)} |"


def figure(row: Row) -> str:
    """A row's value with its interval and sample size."""
    aside = (
        [f"{number(row.low)} to {number(row.high)}"] if row.low is not None and row.high is not None else []
    )
    aside += [f"n = {row.n:,}"] if row.n is not None else []
    return f"{number(row.value)} ({', '.join(aside)})" if aside else number(row.value)


def number(value: float) -> str:
    """Three significant digits, and never fewer than the digits before the point."""
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"
