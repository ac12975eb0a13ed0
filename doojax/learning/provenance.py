"""Which data a model saw, with all that the models it was made with saw."""

from collections.abc import Sequence
from typing import Any

from doojax.datasets.files import MANIFEST
from doojax.datasets.store import Dataset
from doojax.files import file_digest
from doojax.learning.checkpoints import Header

SAW = "saw"  # its name in a header's ``about``


def seen_data(datasets: Sequence[Dataset], models: Sequence[Header] = ()) -> list[dict[str, Any]]:
    """What goes into a header's ``about["saw"]``: one entry a data set, each of them once.

    An entry has the random stream and the seed that the scenes were drawn from (see `doojax.keys`), how many
    they are, and digests of the scene's description and of the data set's manifest. All splits count as seen.
    """
    found = [_entry(dataset) for dataset in datasets]
    for header in models:
        found += header.about.get(SAW, [{"stream": None, "model": header.kind}])
    return [entry for i, entry in enumerate(found) if entry not in found[:i]]


def saw_scenes(header: Header, stream: str, seed: int) -> bool | None:
    """Did a model see scenes of this stream and seed? None: it does not say what it saw."""
    entries = header.about.get(SAW)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        return None
    if any(entry.get("stream") == stream and entry.get("seed") == seed for entry in entries):
        return True
    return None if any(entry.get("stream") is None for entry in entries) else False


def _entry(dataset: Dataset) -> dict[str, Any]:
    config = dataset.config
    return {
        **{name: config.get(name) for name in ("stream", "seed", "task", "phase", "engine", "scene")},
        "trajectories": len(dataset),
        "data": file_digest(dataset.path / MANIFEST)[:16],
    }
