"""What a sweep is: a command with holes, and the values that fill them; each filling is a cell."""

import hashlib
import itertools
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import doojax
from doojax.commands import parsed
from doojax.experiments.reports.provenance import digest
from doojax.files import file_digest
from doojax.keys import generator
from doojax.optional import advice
from doojax.reading import checked

OUT = "out"  # the hole that a cell's own folder fills
LETTERS = 16  # of a cell's digest


@dataclass(frozen=True)
class Spec:
    """What a spec's file says.

    A hole is a name in braces, such as ``{links}``; ``{out}`` is a folder of the cell's own, which every
    command with an ``--out`` should be given.
    """

    command: str  # as a user would type it; several are joined by &&
    grid: dict[str, list[str | int | float | bool]] = field(
        default_factory=dict
    )  # all combinations are tried
    random: dict[str, list[float]] = field(default_factory=dict)  # least and greatest: drawn uniformly
    draws: int = 1  # of what is random, for each point of the grid
    seeds: int = 0  # adds a hole {seed}, filled with 0, 1, ...
    seed: int = 0  # of what is random


@dataclass(frozen=True)
class Cell:
    """One filling of a command's holes."""

    name: str  # a digest of all that its outcome depends on: the folder's name
    values: dict[str, Any]  # by hole
    line: str  # the command, with {out} not filled yet

    def command(self, folder: Path) -> str:
        """The command for a cell in this folder."""
        return self.line.replace("{out}", str(folder / OUT))


def read_spec(path: Path) -> Spec:
    """A spec from a YAML file.

    Raises:
        FileNotFoundError: there is no such file.
        ModuleNotFoundError: PyYAML is missing; the message says what brings it.
        ValueError: it is no YAML, or says something else than a `Spec` does.
    """
    try:
        import yaml
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(advice(error), name=error.name) from error

    if not path.is_file():
        raise FileNotFoundError(f"there is no spec {path}")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        return checked(content, Spec)
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{path} is not the spec of a sweep: {error}") from error


def cells_of(spec: Spec) -> list[Cell]:
    """All cells; a spec with more values has the same cells and others.

    Raises:
        ValueError: a hole has no values, values have no hole, a range is empty, or a command is not
            understood once its holes are filled.
    """
    holes = set(re.findall(r"\{(\w+)\}", spec.command))
    given = {*spec.grid, *spec.random} | ({"seed"} if spec.seeds else set())
    if holes - given - {OUT} or given - holes:
        raise ValueError(
            f"the command has the holes {sorted(holes - {OUT})}, and there are values for {sorted(given)}: "
            "expected the same names"
        )
    for name, ends in spec.random.items():
        if len(ends) != 2 or not ends[0] < ends[1]:
            raise ValueError(f"random {name} is {ends}, expected the least and the greatest value")
    if spec.draws < 1 or spec.seeds < 0 or not all(spec.grid.values()):
        raise ValueError("expected at least one draw, no negative number of seeds, and values for each name")
    found: dict[str, Cell] = {}
    for values in _fillings(spec):
        line = _filled(spec.command, values)
        name = _digest(line)
        found[name] = Cell(name, values, line)
    return list(found.values())


def _filled(command: str, values: dict[str, Any]) -> str:
    return re.sub(r"\{(\w+)\}", lambda hole: str(values.get(hole[1], hole[0])), command)


def _fillings(spec: Spec) -> Iterator[dict[str, Any]]:
    seeds = [{"seed": seed} for seed in range(spec.seeds)] or [{}]
    for point in itertools.product(*spec.grid.values()):
        on_grid = dict(zip(spec.grid, point, strict=True))
        for draw in range(spec.draws if spec.random else 1):
            random = generator(spec.seed, "sweep", str(draw))
            drawn = {
                name: float(np.format_float_scientific(random.uniform(low, high), 6))
                for name, (low, high) in sorted(spec.random.items())
            }
            for seed in seeds:
                yield {**on_grid, **drawn, **seed}


def _digest(line: str) -> str:
    """Of a command, of doojax's version and of the files and data that it names."""
    inputs = {}
    for number, (_, arguments) in enumerate(parsed(line)):
        for name, value in arguments.items():
            for path in value if isinstance(value, tuple) else (value,):
                if isinstance(path, Path) and path.exists():
                    inputs[f"{number}/{name}/{path}"] = (
                        file_digest(path) if path.is_file() else _of_folder(path)
                    )
    text = json.dumps([line, doojax.__version__, inputs], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:LETTERS]


def _of_folder(path: Path) -> str:
    try:
        return digest(path)
    except FileNotFoundError:  # a folder of models: theirs
        return " ".join(digest(one) for one in sorted(path.glob("*/model.eqx")))
