"""Measured figures: the only writer and reader of results/<area>/summary.json.

A file holds `rows`, one figure each, and `runs`, the executions of commands that measured them; a row's
`run` is the index of its own. Several commands may feed one file: a new row replaces the one of the same
metric and tags and belongs to the new run, and a run to which no row belongs any more is dropped. So each
figure keeps the command, seed, versions, device and date under which it was measured, and the digests of the
models, data and scenes that went into it. The `command`, `seed`, `versions`, `device` and `date` of the file
as a whole repeat those of the latest run, the last in `runs`.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from operator import index
from pathlib import Path
from typing import Any, SupportsFloat, SupportsIndex

from rich.console import Console

from doojax.experiments.reports.checks import (
    check,
    check_names,
    check_row,
    check_run,
    refuse_constant,
    require,
)
from doojax.experiments.reports.machine import this_run
from doojax.experiments.reports.rows import HEAD, Row, Run, Summary
from doojax.files import write_whole
from doojax.terminal import labelled, narrow_table

SUMMARY = "summary.json"


def row(
    metric: str,
    tags: Mapping[str, Any],
    value: SupportsFloat,
    unit: str,
    low: SupportsFloat | None = None,
    high: SupportsFloat | None = None,
    n: SupportsIndex | None = None,
) -> Row:
    """Make a row, for `write_summary`, from Python's numbers or NumPy's or JAX's scalars.

    Args:
        metric: what is measured, such as "steps_per_s".
        tags: what tells this figure from others of its metric, such as {"task": "toy", "batch": 64}.
        value: the figure, finite.
        unit: its SI unit; "" for a pure number.
        low: lower end of the 95 % interval, if there is one.
        high: upper end.
        n: sample size.

    Raises:
        ValueError: a figure or tag is not finite, a name is malformed, or low exceeds high.
    """
    fields_of_row = {
        "metric": metric,
        "tags": {name: tag.item() if hasattr(tag, "item") else tag for name, tag in tags.items()},
        "value": float(value),
        "low": None if low is None else float(low),
        "high": None if high is None else float(high),
        "n": None if n is None else index(n),
        "unit": unit,
    }
    check_row(fields_of_row | {"run": 0})
    return Row(**fields_of_row)


def write_summary(
    path: Path | str,
    *,
    command: str,
    seed: int | None,
    rows: Iterable[Row],
    inputs: Mapping[str, str] | None = None,
    measured: Run | None = None,
) -> Summary:
    """Merge freshly measured rows into a summary file, all or nothing, and return what it then holds.

    Two processes must not write one file at once.

    Args:
        path: the file, such as results/simulation/summary.json; it and its folder need not exist.
        command: the command line that measured the rows.
        seed: the seed they depend on, or None.
        rows: at least one, see `row`.
        inputs: digests of the models, data and scenes that the rows depend on, by name.
        measured: where versions, device and date come from; by default from this process, now.

    Raises:
        ValueError: there are no rows, two of them share metric and tags, or the file is not a summary.
    """
    path = Path(path)
    if path.suffix != ".json":
        raise ValueError(f"{path} is not the name of a summary; it must end in .json, such as summary.json")
    here = measured or this_run()
    run = replace(here, command=command, seed=seed, inputs=dict(inputs or {}))
    fresh = Summary((run,), tuple(replace(new, run=0) for new in rows))
    check(fresh)

    old = read_summary(path) if path.exists() else Summary((), ())
    replaced = {new.identity for new in fresh.rows}
    kept = [row for row in old.rows if row.identity not in replaced]
    used = sorted({row.run for row in kept})
    kept = [replace(row, run=used.index(row.run)) for row in kept]
    new = [replace(row, run=len(used)) for row in fresh.rows]
    merged = Summary(
        (*(old.runs[old_index] for old_index in used), run), tuple(sorted([*kept, *new], key=order))
    )
    check(merged)
    write_whole(path, to_json(merged))
    return merged


def read_summary(path: Path | str) -> Summary:
    """Read a summary file and check all of it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not JSON, or a field is missing, unknown or malformed; the message says which.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse_constant)
        check_names(content, {*HEAD, "runs", "rows"})
        runs, rows = content.pop("runs"), content.pop("rows")
        for name, items, check_item in (("runs", runs, check_run), ("rows", rows, check_row)):
            require(isinstance(items, list), name, items, "a list")
            for position, item in enumerate(items):
                try:
                    check_item(item)
                except ValueError as error:
                    raise ValueError(f"{name}[{position}]: {error}") from error
        if content not in [{name: run[name] for name in HEAD} for run in runs[-1:]]:
            raise ValueError("command, seed, versions, device and date must repeat those of the last run")
        summary = Summary(tuple(Run(**item) for item in runs), tuple(Row(**item) for item in rows))
        check(summary)
    except ValueError as error:
        raise ValueError(f"{path} is not a summary of results: {error}. Mend or delete it.") from error
    return summary


def to_json(summary: Summary) -> str:
    """A summary as JSON with one run or row per line, so that a difference is easy to read."""
    parts = [f'"{name}": {to_line(getattr(summary.runs[-1], name))}' for name in HEAD]
    for name, items in (("runs", summary.runs), ("rows", summary.rows)):
        lines = ",\n  ".join(to_line(asdict(item)) for item in items)
        parts.append(f'"{name}": [\n  {lines}\n ]')
    return "{\n " + ",\n ".join(parts) + "\n}\n"


def to_line(value: object) -> str:
    """One value as JSON on one line."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def order(row: Row) -> tuple[object, ...]:
    """Sort key of rows: metric, then tags, numbers by size."""
    return row.metric, sorted((name, isinstance(tag, str), tag) for name, tag in row.tags.items())


def publish_rows(
    folder: Path | None,
    *,
    command: str,
    seed: int | None,
    rows: Iterable[Row],
    inputs: Mapping[str, str] | None = None,
    measured: Run | None = None,
) -> None:
    """`write_summary` to the summary.json of a folder of results, if a user named one to publish to."""
    if folder is not None:
        path = folder / SUMMARY
        write_summary(path, command=command, seed=seed, rows=rows, inputs=inputs, measured=measured)


def show(rows: Sequence[Row], as_json: bool) -> None:
    """Print rows, as a table or as JSON."""
    if as_json:
        print(json.dumps([asdict(one) for one in rows], indent=1))
        return
    table = narrow_table("metric, of what", "value", "95 % interval", "unit")
    for one in rows:
        tags = ", ".join(f"{name} {value}" for name, value in one.tags.items())
        tags = tags.replace(",", ", ").replace(",  ", ", ")  # where a value is a list, a line may end, too
        interval = "" if one.low is None or one.high is None else f"{one.low:,.4g} to {one.high:,.4g}"
        table.add_row(labelled(one.metric, tags), f"{one.value:,.4g}", interval, one.unit)
    Console().print(table)
