"""What a part of a scene is asked for.

A part is a frozen dataclass of plain data. It is asked once what it adds to the MJCF; once, of the compiled
model, where it is found there; and in every simulation to read what it is seen by, to say which points may
touch something, and to be moved rigidly. To add a kind of part, write one and name it in `Scene.parts`.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.geometry.frames import rotate

if TYPE_CHECKING:
    import mujoco

    from doojax.simulation.layout import Observation
    from doojax.simulation.scenes import Scene


class Frames(NamedTuple):
    """Vectors that a part is seen by, of bodies or sites: positions, or the directions of their x axes."""

    kind: Literal["body", "axis", "site"]
    names: tuple[str, ...]


def _none() -> np.ndarray:
    return np.zeros(0, dtype=int)


@dataclass(frozen=True, eq=False)
class Places:
    """Where a part is found in a compiled model; arrays of indices."""

    frames: tuple[np.ndarray, ...] = ()  # ids of the bodies or sites of each of its `Frames`
    qpos: np.ndarray = field(
        default_factory=_none
    )  # of what places it in the world; its shape is the part's own
    dofs: np.ndarray = field(default_factory=_none)  # the velocities of these
    coordinates: np.ndarray = field(
        default_factory=_none
    )  # in (qpos, qvel): what it is seen by besides its frames
    sizes: np.ndarray = field(default_factory=_none)  # ids of geoms, of which the first two sizes are seen
    holds: np.ndarray = field(default_factory=_none)  # ids of the equalities that `SimState.holding` switches


class Turn(NamedTuple):
    """A rigid motion: a turn about the world's origin, then a translation."""

    quaternion: Float[Array, "4"]
    yaw: Float[Array, ""]  # the quaternion's, rad: all that counts in a plane
    translation: Float[Array, "3"]  # m

    def points(self, points: Float[Array, "*b D"]) -> Float[Array, "*b D"]:
        """Places (m) in space, or in the plane."""
        return self.vectors(points) + self.translation[: points.shape[-1]]

    def vectors(self, vectors: Float[Array, "*b D"]) -> Float[Array, "*b D"]:
        """Directions in space, or in the plane."""
        width = vectors.shape[-1]
        if width == 2:
            vectors = jnp.concatenate([vectors, jnp.zeros((*vectors.shape[:-1], 1))], -1)
        return rotate(self.quaternion, vectors)[..., :width]


@dataclass(frozen=True)
class Part:
    """A part that only adds something, which no state knows of. Others override the rest."""

    @property
    def name(self) -> str:
        """Its key in `Layout.places`; one part of a scene has it."""
        return type(self).__name__.lower()

    def add(self, spec: "mujoco.MjSpec", scene: "Scene") -> None:
        """Add bodies, joints, geoms, equalities and actuators."""
        raise NotImplementedError

    def frames(self) -> tuple[Frames, ...]:
        """The vectors that it is seen by."""
        return ()

    def find(self, model: "mujoco.MjModel") -> Places:
        """Its addresses; `Places.frames` are looked up by `frames`."""
        return Places()

    def see(
        self,
        vectors: list[Float[Array, "*b _ 3"]],
        coordinates: Float[Array, "*b C"],
        sizes: Float[Array, "*b Z 2"],
    ) -> dict[str, Array]:
        """Fields of a `State` or an `Observation`, from one array for each of its frames, and its places."""
        return {}

    def samples(self, seen: "Observation") -> list[tuple[Float[Array, "P 3"], Float[Array, "P"]]]:
        """Points (m) that may touch an obstacle, and the radius (m) around each."""
        return []

    def moved(self, places: Places, qpos: Array, qvel: Array, turn: Turn) -> tuple[Array, Array]:
        """All of qpos and qvel, with this part of them moved rigidly."""
        return qpos, qvel


def find_frames(model: "mujoco.MjModel", frames: tuple[Frames, ...]) -> tuple[np.ndarray, ...]:
    """Ids of the bodies or sites of each of a part's frames."""
    of = {"body": model.body, "axis": model.body, "site": model.site}
    return tuple(np.array([of[one.kind](name).id for name in one.names], dtype=int) for one in frames)


def put(values: Float[Array, "n"], addresses: np.ndarray, new: Array) -> Float[Array, "n"]:
    """``values`` with ``new`` at the addresses."""
    at, new = addresses.reshape(-1), new.reshape(-1)
    if at.size and (at == at[0] + np.arange(at.size)).all():  # as one piece: a scatter rounds otherwise
        return jnp.concatenate([values[: at[0]], new, values[at[-1] + 1 :]])
    return values.at[at].set(new)


def split(values: Any, counts: list[int], axis: int) -> list[Any]:
    """An array cut along an axis into pieces of these lengths."""
    return jnp.split(values, np.cumsum(counts)[:-1], axis=axis) if counts else []
