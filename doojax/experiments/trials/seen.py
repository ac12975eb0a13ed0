"""Scenes that a model learned from say nothing about how it does elsewhere: they are refused, or marked."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from doojax.learning.checkpoints import read_header
from doojax.learning.provenance import saw_scenes

Seen = Literal["no", "yes", "unknown"]


def check_unseen(stream: str, seed: int, models: Mapping[str, Path], *, allow_seen: bool = False) -> Seen:
    """Did any of some models see the scenes that were drawn from this stream by this seed?

    Args:
        stream: the scenes' random stream, such as scenes/rope_dragging/easy.
        seed: theirs.
        models: files by kind.
        allow_seen: go on where they were seen.

    Returns:
        "yes", or "unknown" where a model does not say what it saw, or "no".

    Raises:
        ValueError: they were seen, and that is not allowed; the message names the model.
    """
    found: dict[str, bool | None] = {}
    for path in models.values():
        found[str(path)] = saw_scenes(read_header(path)[0], stream, seed)
    seen = [path for path, saw in found.items() if saw]
    if seen and not allow_seen:
        raise ValueError(
            f"{', '.join(seen)} saw the scenes of stream {stream}, seed {seed}, in training, so that success "
            "there is no evidence: draw others by doojax scenes --seed, or mark the results by --allow-seen"
        )
    if seen:
        return "yes"
    return "unknown" if None in found.values() else "no"


def warning_of(seen: Seen, method: str) -> str | None:
    """What to tell who looks at the results."""
    if seen == "yes":
        return f"{method} saw these scenes in training: its results are no evidence"
    if seen == "unknown":
        return f"{method} does not say which data it saw: train it again, or take its results with care"
    return None
