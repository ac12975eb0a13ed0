"""Text for the page, which takes Markdown and would render and run any HTML in it."""

import json
import re
from collections.abc import Mapping
from typing import Any


def plain(text: object) -> str:
    """Markdown that shows a text as it is. All that comes from a file goes through here."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", str(text))


def listed(about: Mapping[str, Any]) -> str:
    """Names and values, one a line, as Markdown."""
    return "  \n".join(f"{plain(name)}: **{plain(json.dumps(value))}**" for name, value in about.items())
