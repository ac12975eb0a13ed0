"""How planners, learners and trials show what they do without knowing a viewer.

Pass a `Drawing` to whatever has something to show. The viewer implements it twice: in the web page and as
pictures.

Names are paths: "plan/tree" lies below "plan". Lengths are metres, in the world frame with z up; quaternions
are (w, x, y, z); a colour is (red, green, blue) from 0 to 255.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from doojax.types import Obstacles

Colour = tuple[int, int, int]
Colours = UInt8[np.ndarray, "K 3"]


@runtime_checkable
class Drawing(Protocol):
    """Shows named things. Drawing a name again replaces what it showed."""

    def rope(
        self,
        name: str,
        points: Float[np.ndarray, "N 3"],
        *,
        radius: float,
        colour: Colour,
        opacity: float = 1.0,
    ) -> None:
        """A smooth tube along ``points``; nothing where one of them is not finite."""
        ...

    def spheres(
        self,
        name: str,
        centres: Float[np.ndarray, "K 3"],
        *,
        radius: float,
        colours: Colour | Colours,
        opacity: float = 1.0,
    ) -> None:
        """Balls: grippers, goals, points of a rope."""
        ...

    def points(
        self, name: str, points: Float[np.ndarray, "K 3"], *, size: float, colours: Colour | Colours
    ) -> None:
        """Dots of ``size`` metres: made for many thousands."""
        ...

    def lines(
        self,
        name: str,
        segments: Float[np.ndarray, "K 2 3"],
        *,
        width: float,
        colours: Colour | Colours,
    ) -> None:
        """Straight segments, ``width`` pixels wide: curves, ways, what belongs together."""
        ...

    def cones(
        self, name: str, segments: Float[np.ndarray, "K 2 3"], *, radius: float, colours: Colour | Colours
    ) -> None:
        """Slender cones, each with its base at its segment's start: one object for all edges of a tree."""
        ...

    def obstacles(self, name: str, obstacles: Obstacles, *, colour: Colour, opacity: float = 1.0) -> None:
        """The active primitives of one set of obstacles."""
        ...

    def bodies(
        self, name: str, shapes: Obstacles, *, colours: Colour | Colours, opacity: float = 1.0
    ) -> None:
        """The active ones of some primitives that move, such as a robot's links, each in its colour."""
        ...

    def axes(
        self,
        name: str,
        position: Float[np.ndarray, "3"],
        quaternion: Float[np.ndarray, "4"],
        *,
        length: float = 0.1,
    ) -> None:
        """A frame: x red, y green, z blue."""
        ...

    def text(self, name: str, text: str, position: Float[np.ndarray, "3"]) -> None:
        """A few words at a place."""
        ...

    def remove(self, name: str) -> None:
        """Take away what a name and the names below it show; nothing happens if that is nothing."""
        ...
