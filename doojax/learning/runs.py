"""A run's directory: config.json, environment.json, metrics.jsonl, last.eqx to go on from, model.eqx."""

import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PyTree

import doojax
from doojax.datasets.files import describe_contents, write_atomically
from doojax.learning.checkpoints import MODEL, Header, read_json_line, read_leaves, save_model, write_leaves

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
        config = json.loads(json.dumps(config, allow_nan=False))
        if (path / CONFIG).exists():
            old = json.loads((path / CONFIG).read_text(encoding="utf-8"))
            changed = [
                f"{name}: {old.get(name)!r} -> {config.get(name)!r}"
                for name in {**old, **config}
                if old.get(name) != config.get(name)
            ]
            if changed:
                raise ValueError(
                    f"{path} holds another run (old -> new):\n  " + "\n  ".join(changed) + "\n"
                    "choose another folder, or train with the old settings to go on with it"
                )
        elif path.exists() and (not path.is_dir() or any(path.iterdir())):
            held = describe_contents(path) if path.is_dir() else "a file"
            raise ValueError(f"{path} is not a run: it holds {held}; choose a new or empty folder")
        else:
            path.mkdir(parents=True, exist_ok=True)
            write_atomically(path / ENVIRONMENT, json.dumps(environment(), indent=2) + "\n")
            write_atomically(path / CONFIG, json.dumps(config, indent=2) + "\n")
        return cls(path)

    @property
    def finished(self) -> bool:
        """Is the model there?"""
        return (self.path / MODEL).exists()

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """What was logged, one dict per epoch."""
        file = self.path / METRICS
        lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        return [json.loads(line) for line in lines]

    def log(self, record: dict[str, Any]) -> None:
        """Append one epoch's figures."""
        with (self.path / METRICS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")

    def save(self, epoch: int, state: PyTree) -> None:
        """Keep the state after an epoch, in place of the one before."""
        write_leaves(self.path / LAST, {"epoch": epoch}, state)

    def resume(self, start: PyTree) -> tuple[int, PyTree]:
        """The last epoch kept and the state after it, or 0 and ``start``; forgets what was logged later."""
        epoch, state = 0, start
        if (self.path / LAST).exists():
            header = read_json_line(self.path / LAST)
            if header is None or not isinstance(header.get("epoch"), int):
                raise ValueError(f"{self.path / LAST} is damaged: delete it to train from the start")
            epoch, state = header["epoch"], read_leaves(self.path / LAST, start)
        whole = []
        if (self.path / METRICS).exists():
            for line in (self.path / METRICS).read_text(encoding="utf-8").splitlines():
                try:
                    record = json.loads(line)
                except ValueError:  # killed while writing it
                    break
                if record["epoch"] <= epoch:
                    whole.append(line)
        write_atomically(self.path / METRICS, "".join(f"{line}\n" for line in whole))
        return epoch, state

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
