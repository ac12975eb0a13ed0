"""Findings as rows of results and as a table to read."""

from collections.abc import Iterator, Sequence

import numpy as np
from rich.console import Console

from doojax.benchmarks.physics.cases import Finding
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import row
from doojax.terminal import labelled, narrow_table

SHOWN_APART = ("engine", "task", "settings")


def rows(findings: Sequence[Finding]) -> Iterator[Row]:
    """Of each finding its value and its error; of one without a value that it has none."""
    for one in findings:
        if np.isfinite(one.value):
            yield row(one.case, one.tags, one.value, one.unit)
            yield row(f"{one.case}_error", one.tags, one.error, "")
        else:
            yield row(f"{one.case}_without_value", one.tags | {"because": verdict(one)}, 1, "")


def show(findings: Sequence[Finding]) -> None:
    """Print value, closed form, error and verdict of each."""
    table = narrow_table("case, of what", "value", "closed\nform", "error", "")
    for one in findings:
        place = ", ".join(str(one.tags[name]) for name in SHOWN_APART if name in one.tags)
        more = (f"{name} {value}" for name, value in one.tags.items() if name not in SHOWN_APART)
        figures = (f"{one.value:.4g} {one.unit}", f"{one.expected:.4g}", f"{one.error:+.2%}")
        table.add_row(labelled(one.case, ", ".join((place, *more))), *figures, verdict(one))
    Console().print(table)


def line(one: Finding) -> str:
    """A finding in one line."""
    place = ", ".join(str(one.tags.get(name, "")) for name in SHOWN_APART)
    figures = f"{one.value:.4g} {one.unit} for {one.expected:.4g} ({one.error:+.2%})"
    return f"{named(one)} ({place}): {figures} {verdict(one)} {one.note}".rstrip()


def named(one: Finding) -> str:
    """The case with those tags that have no column of their own."""
    more = (f"{name} {value}" for name, value in one.tags.items() if name not in SHOWN_APART)
    return ", ".join((one.case, *more))


def verdict(one: Finding) -> str:
    """Right, off, burst or refused."""
    if one.note.startswith("refused"):
        return "refused"
    if not np.isfinite(one.value):
        return "burst"
    return "right" if one.right else "off"
