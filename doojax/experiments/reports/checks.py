"""What is refused in a summary of results, and with which words."""

import math
import re
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from doojax.experiments.reports.rows import HEAD, Row, Summary


def check(summary: Summary) -> None:
    """Raise a ValueError where runs and rows, each sound alone, do not fit together."""
    if not summary.rows:
        raise ValueError("there are no rows")
    units: dict[str, str] = {}
    identities: set[str] = set()
    for row in summary.rows:
        require(row.run < len(summary.runs), f"run of {row.identity}", row.run, f"below {len(summary.runs)}")
        if row.identity in identities:
            raise ValueError(f"{row.identity} is there twice; rows of one metric must differ in their tags")
        identities.add(row.identity)
        unit = units.setdefault(row.metric, row.unit)
        if row.unit != unit:
            raise ValueError(
                f"{row.metric} is given in {unit!r} and in {row.unit!r}; use one unit, and measure again "
                "what is in the other"
            )


def check_run(item: object) -> None:
    """Raise a ValueError unless this is a run as JSON has it."""
    item = check_names(item, set(HEAD), optional={"inputs", "note"})
    for name in ("command", "device", "date"):
        require(isinstance(item[name], str), name, item[name], "a text")
    require(isinstance(item.get("note", ""), str), "note", item.get("note"), "a text")
    require(item["seed"] is None or is_integer(item["seed"]), "seed", item["seed"], "an integer or null")
    inputs = item.get("inputs", {})
    for name, texts, expected in (
        ("versions", item["versions"], "names of packages with their versions"),
        ("inputs", inputs, "names of models, data and scenes with their digests"),
    ):
        sound = isinstance(texts, dict) and all(isinstance(text, str) for text in texts.values())
        require(sound, name, texts, expected)


def check_row(item: object) -> None:
    """Raise a ValueError unless this is a row as JSON has it."""
    item = check_names(item, {field.name for field in fields(Row)})
    metric, tags, low, high, n = (item[name] for name in ("metric", "tags", "low", "high", "n"))
    require(is_name(metric), "metric", metric, "lower-case letters, digits and underscores")
    require(isinstance(tags, dict), "tags", tags, "names with values")
    for name, tag in tags.items():
        require(is_name(name), "the name of a tag", name, "lower-case letters, digits and underscores")
        require(
            isinstance(tag, str | bool) or is_finite(tag), f"tag {name!r}", tag, "a text or finite number"
        )
    require(is_finite(item["value"]), f"value of {metric} {tags}", item["value"], "a finite number")
    if (low, high) != (None, None):
        ordered = is_finite(low) and is_finite(high) and low <= high
        require(ordered, f"interval of {metric} {tags}", (low, high), "finite low <= high")
    require(n is None or (is_integer(n) and n > 0), "n", n, "a positive integer or null")
    require(isinstance(item["unit"], str), "unit", item["unit"], "a text")
    require(is_integer(item["run"]) and item["run"] >= 0, "run", item["run"], "an index")


def check_names(
    item: object, expected: set[str], optional: frozenset[str] | set[str] = frozenset()
) -> Mapping[str, Any]:
    """The item, if it is a JSON object with just these fields; a ValueError names what is amiss."""
    if not isinstance(item, dict):
        raise ValueError(f"it is {item!r}; expected an object")
    missing, unknown = expected - set(item), set(item) - expected - optional
    wrong = [f"lacks {', '.join(sorted(missing))}"] if missing else []
    wrong += [f"has unknown {', '.join(sorted(unknown))}"] if unknown else []
    if wrong:
        raise ValueError(f"it {' and '.join(wrong)}")
    return item


def require(fits: object, name: str, value: object, expected: str) -> None:
    """Raise a ValueError that says what `name` is and should be, unless it fits."""
    if not fits:
        raise ValueError(f"{name} is {value!r}; expected {expected}")


def refuse_constant(text: str) -> float:
    """JSON has no NaN and no infinity, though Python's reader takes them."""
    raise ValueError(f"it holds {text}; figures must be finite")


def is_integer(value: object) -> bool:
    """Is this an integer, and not a boolean?"""
    return isinstance(value, int) and not isinstance(value, bool)


def is_finite(value: object) -> bool:
    """Is this a finite number, and not a boolean?"""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def is_name(value: object) -> bool:
    """Is this a name for a metric or a tag?"""
    return isinstance(value, str) and re.fullmatch(r"[a-z][a-z0-9_]*", value) is not None
