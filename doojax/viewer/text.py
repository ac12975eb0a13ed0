"""Text for the page, which takes Markdown and would render and run any HTML in it."""

import json
import re
from collections.abc import Mapping
from typing import Any

from doojax.experiments.drawing import Colour
from doojax.viewer import colours


def plain(text: object) -> str:
    """Markdown that shows a text as it is. All that comes from a file goes through here."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", str(text))


def shortened(text: object, most: int = 44) -> str:
    """A text, such as a path, of at most so many letters: what is too long loses its middle."""
    said = str(text)
    if len(said) <= most:
        return said
    end = 2 * (most - 1) // 3  # the end says more
    return f"{said[: most - 1 - end]}…{said[-end:]}"


def listed(about: Mapping[str, Any]) -> str:
    """Names and values, one a line, as Markdown."""
    return "  \n".join(f"{plain(name)}: **{plain(json.dumps(value))}**" for name, value in about.items())


def legend(meanings: Mapping[str, Colour | str]) -> str:
    """What colours mean, as HTML; in place of one colour, the name of a scale such as "viridis"."""
    entries = []
    for meaning, shown in meanings.items():
        stops = colours.SCALES[shown] if isinstance(shown, str) else [shown, shown]
        gradient = ", ".join(f"rgb{stop}" for stop in stops)
        width = 2.4 if isinstance(shown, str) else 0.8
        swatch = f"width: {width}em; height: 0.8em; border-radius: 0.4em; display: inline-block"
        swatch = f'<span style="{swatch}; background: linear-gradient(to right, {gradient})"></span>'
        entries.append(f'<span style="white-space: nowrap; margin-right: 0.9em">{swatch} {meaning}</span>')
    style = "padding: 0 0.75em 0.5em; font-size: 0.85em; line-height: 1.5"
    return f'<div style="{style}">{" ".join(entries)}</div>'
