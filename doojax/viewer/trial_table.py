"""The trials of an evaluation as a table: rates on top, what is filtered and sorted, some rows at a time."""

import html
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from doojax.experiments.drawing import Colour
from doojax.experiments.reports.statistics import success_rate
from doojax.experiments.trials.outcomes import METHOD
from doojax.experiments.trials.recipes import RECIPES
from doojax.experiments.trials.trial_list import TrialLine, list_trials
from doojax.viewer import colours
from doojax.viewer.addresses import address

ROWS = 9  # shown at once
SHOWN = "padding: 0 0.75em 0.5em; font-size: 0.8em; line-height: 1.45; container-type: inline-size"
# the table of a narrow panel has four columns, and says the rest in its sentences
NARROW = (
    "<style>.narrow { display: none } "
    ".trials td, .trials th { padding: 0 0.4em 0 0; text-align: left; vertical-align: top } "
    ".trials td { overflow-wrap: break-word } .trials .number { text-align: right; white-space: nowrap } "
    "@container (max-width: 330px) { .wide { display: none } .narrow { display: inline } }</style>"
)
ALL, FAILED, REACHED = "all", "failed only", "reached only"
SORTS: Mapping[str, Callable[["Row"], tuple]] = {
    "scene": lambda row: (row.line.trial, row.method),
    "method": lambda row: (row.method, row.line.trial),
    "outcome": lambda row: (row.line.reached, row.line.trial, row.method),
    "why": lambda row: (row.line.why, row.line.trial),
    "error": lambda row: (row.line.error_m is None, row.line.error_m or 0.0),
    "searches": lambda row: (row.line.searches, row.line.trial),
    "actions": lambda row: (row.line.actions, row.line.trial),
    "seconds": lambda row: (row.line.plan_s, row.line.trial),
}


class Row(NamedTuple):
    """One trial of one method."""

    method: str
    line: TrialLine


def read_rows(folder: Path) -> list[Row]:
    """All trials of an evaluation, in the order of its methods.

    Raises:
        ValueError: a list or a record is damaged, or there is no trial yet.
    """
    names = sorted(file.parent.name for file in folder.glob(f"*/{METHOD}"))
    known = list(RECIPES)
    names.sort(key=lambda name: known.index(name) if name in known else len(known))
    rows = [Row(name, line) for name in names for line in list_trials(folder / name)]
    if not rows:
        raise ValueError(f"{folder} is empty: no trial is finished yet")
    return rows


def methods_of(rows: Sequence[Row]) -> list[str]:
    """The methods, in order."""
    return list(dict.fromkeys(row.method for row in rows))


def choices(rows: Sequence[Row]) -> list[str]:
    """What one may choose to see: outcomes, and what one method reached and another did not."""
    names = methods_of(rows)
    pairs = [f"{one} reached, {other} did not" for one in names for other in names if one != other]
    return [ALL, FAILED, REACHED, *pairs]


def chosen(rows: Sequence[Row], choice: str, method: str, order: str, descending: bool) -> list[int]:
    """Indices of the rows to see, in order.

    Args:
        rows: all.
        choice: one of `choices`; of pairs, the rows of both methods are seen.
        method: whose rows alone; `ALL` for all.
        order: one of `SORTS`.
        descending: the greatest first.
    """
    found = range(len(rows))
    if choice in (FAILED, REACHED):
        found = [index for index in found if rows[index].line.reached == (choice == REACHED)]
    elif choice != ALL:
        one, other = choice.removesuffix(" did not").split(" reached, ")
        reached = {(row.method, row.line.trial): row.line.reached for row in rows}
        scenes = {
            row.line.trial
            for row in rows
            if reached.get((one, row.line.trial)) is True and reached.get((other, row.line.trial)) is False
        }
        found = [i for i in found if rows[i].method in (one, other) and rows[i].line.trial in scenes]
    if method != ALL:
        found = [index for index in found if rows[index].method == method]
    return sorted(found, key=lambda index: SORTS[order](rows[index]), reverse=descending)


def rates(rows: Sequence[Row]) -> str:
    """How often each method reaches the goal, with Wilson's 95 % interval, as HTML."""
    lines = []
    for method in methods_of(rows):
        outcomes = np.array([row.line.reached for row in rows if row.method == method])
        rate = success_rate(outcomes)
        value, low, high = (100 * part for part in rate[:3])
        bar = (
            f'<span style="display: inline-block; width: 5em; height: 0.6em; background: #e9ecef">'
            f'<span style="display: block; margin-left: {low / 20:.2f}em; width: {(high - low) / 20:.2f}em; '
            f'height: 100%; background: {css(colours.method_colour(method))}"></span></span>'
        )
        lines.append(
            f"<tr><td>{dot(method)} {html.escape(method)}</td><td>{bar}</td>"
            f"<td>{value:.0f} % ({low:.0f} to {high:.0f})</td><td>n = {rate.n}</td></tr>"
        )
    return f'<div style="{SHOWN}"><table style="border-spacing: 0.5em 0">{"".join(lines)}</table></div>'


def table(rows: Sequence[Row], order: Sequence[int], place: int, shown: Mapping[str, object]) -> str:
    """Some rows around a place in an order, as HTML: each leads to its trial by its address.

    Args:
        rows: all.
        order: indices of rows.
        place: in the order, whose row is marked.
        shown: what an address must say to lead to this page.
    """
    first = max(0, min(place - ROWS // 2, len(order) - ROWS))
    heads = [f"<th>{head}</th>" for head in ("scene", "method", "outcome")]
    heads.append('<th class="number">error</th>')
    heads += [f'<th class="number wide">{head}</th>' for head in ("searches", "actions", "s")]
    lines = [f"<tr>{''.join(heads)}</tr>"]
    for index in order[first : first + ROWS]:
        row, line = rows[index], rows[index].line
        link = address({**shown, "method": row.method, "scene": line.trial})
        error = "" if line.error_m is None else f"{100 * line.error_m:.1f} cm"
        outcome = "reached" if line.reached else "<b>failed</b>"
        cells = (
            f'<a href="{html.escape(link)}">{line.trial}</a>',
            f"{dot(row.method)} {html.escape(row.method).replace('_', '_<wbr>')}",
            outcome,
        )
        numbers = (f"{line.searches}", f"{line.actions}", f"{line.plan_s:.1f}")
        said = f"{line.searches} searches, {line.actions} actions, {line.plan_s:.1f} s: "
        every = [f"<td>{cell}</td>" for cell in cells] + [f'<td class="number">{error}</td>']
        every += [f'<td class="number wide">{number}</td>' for number in numbers]
        back = "background: #e7f1fb" if order[place] == index else ""
        lines.append(f'<tr style="{back}">{"".join(every)}</tr>')
        why = f'<span class="narrow">{said}</span>{html.escape(line.why)}'
        lines.append(f'<tr style="{back}; color: #6e7680"><td></td><td colspan="6">{why}</td></tr>')
    rows_shown = f'<table style="border-spacing: 0; width: 100%">{"".join(lines)}</table>'
    return f'{NARROW}<div class="trials" style="{SHOWN}">{rows_shown}</div>'


def beside(rows: Sequence[Row], index: int, shown: Mapping[str, object]) -> str:
    """What every method came to in the scene of a row, side by side, as HTML; "" where there is but one.

    Args:
        rows: all.
        index: of the row.
        shown: what an address must say to lead to this page.
    """
    scene = rows[index].line.trial
    same = [row for row in rows if row.line.trial == scene]
    if len(same) < 2:
        return ""
    lines = []
    for row in same:
        line = row.line
        link = address({**shown, "method": row.method, "scene": scene})
        name = html.escape(row.method)
        name = f"<b>{name}</b>" if row is rows[index] else f'<a href="{html.escape(link)}">{name}</a>'
        error = "" if line.error_m is None else f", {100 * line.error_m:.1f} cm away"
        outcome = f"{'reached' if line.reached else 'failed'}{error}"
        lines.append(f"<tr><td>{dot(row.method)} {name}</td><td>{outcome}, {line.actions} actions</td></tr>")
    table = f'<table style="border-spacing: 0.5em 0">{"".join(lines)}</table>'
    return f'<div class="beside" style="{SHOWN}">in scene {scene}:{table}</div>'


def dot(method: str) -> str:
    """A dot in a method's colour, as HTML."""
    style = "display: inline-block; width: 0.8em; height: 0.8em; border-radius: 0.4em"
    return f'<span style="{style}; background: {css(colours.method_colour(method))}"></span>'


def css(colour: Colour) -> str:
    """A colour for HTML."""
    return f"rgb{colour}"
