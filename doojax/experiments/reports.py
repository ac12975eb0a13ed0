"""Measured figures: the only writer and reader of results/<area>/summary.json.

A file holds `rows`, one figure each, and `runs`, the executions of commands that measured them; a row's
`run` is the index of its own. Several commands may feed one file: a new row replaces the one of the same
metric and tags and belongs to the new run, and a run to which no row belongs any more is dropped. So each
figure keeps the command, seed, versions, device and date under which it was measured, and the digests of the
models, data and scenes that went into it. The `command`, `seed`, `versions`, `device` and `date` of the file
as a whole repeat those of the latest run, the last in `runs`.
"""

import json
import math
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from importlib import metadata
from operator import index
from pathlib import Path
from typing import Any, SupportsFloat, SupportsIndex

from rich.console import Console
from rich.table import Table

import doojax
from doojax.files import write_whole

type Tag = str | int | float | bool

HEAD = ("command", "seed", "versions", "device", "date")  # of the latest run, repeated for the whole file
SUMMARY = "summary.json"

# What a version is called in a file -> the package that has it.
PACKAGES = {
    "jax": "jax",
    "jaxlib": "jaxlib",
    "mujoco": "mujoco",
    "mujoco-mjx": "mujoco-mjx",
    "numpy": "numpy",
    "warp": "warp-lang",
}


@dataclass(frozen=True)
class Run:
    """One execution of a command that measured something."""

    command: str  # complete: running it again gives the rows again
    seed: int | None  # None where nothing was drawn at random
    versions: Mapping[str, str]
    device: str
    date: str  # UTC, ISO 8601
    inputs: Mapping[str, str] = field(default_factory=dict)  # SHA-256, its beginning, of models, data, scenes
    note: str = ""  # what keeps an old run's command from being run again as it stands


@dataclass(frozen=True)
class Row:
    """One measured figure; `row` makes one."""

    metric: str
    tags: Mapping[str, Tag]
    value: float
    low: float | None  # 95 % interval
    high: float | None
    n: int | None  # sample size
    unit: str  # SI where there is one; "" for a pure number
    run: int = 0  # index into Summary.runs

    @property
    def identity(self) -> str:
        """What a newer measurement of the same thing shares with this one."""
        return f"{self.metric} {json.dumps(dict(self.tags), sort_keys=True)}"


@dataclass(frozen=True)
class Summary:
    """What one summary.json holds."""

    runs: tuple[Run, ...]  # oldest first
    rows: tuple[Row, ...]  # by metric, then tags


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


def this_run() -> Run:
    """Versions and device of this process, and the date, of a command without a name."""
    return Run("", None, versions(), device(), datetime.now(UTC).isoformat(timespec="seconds"))


def versions() -> dict[str, str]:
    """The versions of Python, doojax and the installed packages that a figure may depend on."""
    found = {"python": platform.python_version(), "doojax": doojax.__version__}
    for name, package in PACKAGES.items():
        try:
            found[name] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def device() -> str:
    """What this process computes on: the GPU that JAX uses, if any, and the CPU with its usable cores."""
    import jax  # here, because reading a summary needs no JAX

    from doojax.parts import processors

    cores = processors()
    try:
        models = re.findall(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        models = []
    model = models[0] if models else platform.processor() or platform.machine()
    cpu = f"{model}, {cores} {'core' if cores == 1 else 'cores'}"
    return f"{jax.devices()[0].device_kind}; {cpu}" if jax.default_backend() == "gpu" else cpu


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
    table = Table("metric", "of", "value", "95 % interval", "unit")
    for one in rows:
        tags = ", ".join(f"{name} {value}" for name, value in one.tags.items())
        interval = "" if one.low is None or one.high is None else f"{one.low:,.4g} to {one.high:,.4g}"
        table.add_row(one.metric, tags, f"{one.value:,.4g}", interval, one.unit)
    Console().print(table)
