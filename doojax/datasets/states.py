"""The fields that hold states: of each kind of `doojax.types.State`, its arrays by name."""

from collections.abc import Collection
from dataclasses import fields

from doojax.types import PouringState, PushingState, RopeState

KINDS = (RopeState, PushingState, PouringState)


def state_names(stored: Collection[str]) -> tuple[type, tuple[str, ...]]:
    """The kind of state whose fields are all there, and their names.

    Raises:
        ValueError: there is none.
    """
    for kind in KINDS:
        names = tuple(one.name for one in fields(kind))
        if set(names) <= set(stored):
            return kind, names
    kinds = "; ".join(", ".join(one.name for one in fields(kind)) for kind in KINDS)
    raise ValueError(f"the fields {', '.join(stored)} hold no states, which would be {kinds}")
