"""What planning needs of a task; `doojax.tasks` has tasks that are more than that."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from numpy import ndarray

from doojax.actions import ActionSpace
from doojax.geometry.box import Box


@runtime_checkable
class Task(Protocol):
    """What can be done, and where; hashable, because planners are compiled for it."""

    @property
    def name(self) -> str:
        """What error messages call it."""
        ...

    @property
    def actions(self) -> ActionSpace:
        """What can be done."""
        ...

    @property
    def workspace(self) -> Box:
        """Where all bodies can be, and so every goal, metres."""
        ...

    def reach(self) -> Float[ndarray, "K K"]:
        """How far apart (m) each two bodies can get; infinite where nothing holds them together."""
        ...
