"""A run's directory: config.json, environment.json, metrics.jsonl, last.eqx to go on from, model.eqx."""

import json
import platform
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PyTree

import doojax
from doojax.files import append_line, claim, write_whole
from doojax.learning.checkpoints import MODEL, Header, read_json_line, read_leaves, save_model, write_leaves
from doojax.reading import checked, parsed, read_lines

CONFIG, ENVIRONMENT, METRICS, LAST = "config.json", "environment.json", "metrics.jsonl", "last.eqx"


class RunDirectory:
    """One training run on disk. `RunDirectory.open` makes one, or goes on with one of the same config."""

    def __init__(self, path: Path):
        """Use `RunDirectory.open`."""
        self.path = path

    @classmethod
    def open(cls, path: Path | str, config: dict[str, Any]) -> "RunDirectory":
        """Begin a run, or return to one that was begun with the same config.

        Args:
            path: a folder that is absent, empty, or holds this very run, perhaps unfinished.
            config: all that determines the result, as JSON values.

        Raises:
            ValueError: for a folder that holds something else, naming what differs.
        """
        path = Path(path)
        claim(path, CONFIG, config, "run", leftovers=(ENVIRONMENT,))
        if not (path / ENVIRONMENT).exists():
            write_whole(path / ENVIRONMENT, json.dumps(environment(), indent=2) + "\n")
        return cls(path)

    @property
    def finished(self) -> bool:
        """Is the model there?"""
        return (self.path / MODEL).exists()

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """What was logged, one dict per epoch; not a line that is being written, or that a kill cut off.

        Raises ValueError where the file is damaged.
        """
        lines = read_lines(self.path / METRICS, dict[str, int | float | list[float]], "an epoch's figures")
        for number, line in enumerate(lines, start=1):
            if line.keys() != {"epoch", *lines[0]} or not isinstance(line["epoch"], int):
                raise ValueError(
                    f"{self.path / METRICS}, line {number}, has {', '.join(line)}; expected epoch and what "
                    f"line 1 has: {', '.join(lines[0])}"
                )
        return lines

    def log(self, record: dict[str, Any]) -> None:
        """Append one epoch's figures."""
        append_line(self.path / METRICS, json.dumps(record))

    def save(self, epoch: int, state: PyTree) -> None:
        """Keep the state after an epoch, in place of the one before."""
        write_leaves(self.path / LAST, {"epoch": epoch}, state)

    def resume(self, start: PyTree) -> tuple[int, PyTree]:
        """The last epoch kept and the state after it, or 0 and ``start``; forgets what was logged later."""
        epoch, state = 0, start
        if (self.path / LAST).exists():
            header = read_json_line(self.path / LAST)
            epoch = (header or {}).get("epoch")
            if not isinstance(epoch, int) or epoch < 0:
                raise ValueError(f"{self.path / LAST} is damaged: delete it to train from the start")
            state = read_leaves(self.path / LAST, start)
        self.forget_after(epoch)
        return epoch, state

    def forget_after(self, epoch: int) -> None:
        """Leave of what was logged the epochs up to one, as far as their lines are whole."""
        write_whole(self.path / METRICS, "".join(f"{line}\n" for line in self._lines_until(epoch)))

    def _lines_until(self, epoch: int) -> Iterator[str]:
        """The lines of the epochs up to one, as far as they are whole."""
        file = self.path / METRICS
        for line in file.read_bytes().splitlines() if file.exists() else []:
            try:
                logged = checked(parsed(line), dict[str, Any]).get("epoch")
            except ValueError:  # killed while writing it
                return
            if isinstance(logged, int) and logged <= epoch:
                yield line.decode()

    def finish(self, header: Header, model: PyTree) -> None:
        """Write the model, after which the run counts as finished."""
        save_model(self.path / MODEL, header, model)


def environment() -> dict[str, str]:
    """Versions and device of this process."""
    packages = ("jax", "jaxlib", "equinox", "optax", "numpy")
    return {
        "python": platform.python_version(),
        "doojax": doojax.__version__,
        **{name: version(name) for name in packages},
        "device": jax.devices()[0].device_kind,
    }
