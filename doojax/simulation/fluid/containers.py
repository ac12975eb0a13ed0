"""Containers of boxes, and what is in them."""

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.simulation.fluid.settings import FluidSettings
from doojax.types import Obstacles, ShapeKind


@dataclass(frozen=True)
class Container:
    """An open box, turned about y: x and y are its floor's sides, z its height, all of the room inside."""

    width: float  # m, along x
    depth: float  # m, along y
    height: float  # m
    wall: float = 0.02  # m, of floor and walls

    def __post_init__(self):
        """Refuse what is none."""
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"a container's {name} is {value}, expected a positive length (m)")

    @property
    def centres(self) -> Float[np.ndarray, "5 3"]:
        """Of floor, left, right, front and back, from the middle of the inner floor, m."""
        x, y, z = (self.width + self.wall) / 2, (self.depth + self.wall) / 2, self.height / 2
        floor = [0.0, 0.0, -self.wall / 2]
        return np.array([floor, [-x, 0, z], [x, 0, z], [0, -y, z], [0, y, z]], np.float32)

    @property
    def half_sizes(self) -> Float[np.ndarray, "5 3"]:
        """Of the same, m."""
        thin, high = self.wall / 2, self.height / 2
        x, y = self.width / 2 + self.wall, self.depth / 2 + self.wall
        return np.array(
            [[x, y, thin], [thin, y, high], [thin, y, high], [x, thin, high], [x, thin, high]], np.float32
        )

    def room(self, settings: FluidSettings) -> int:
        """How many particles fit in, in rows."""
        return int(
            np.prod([max(0, math.floor(side / settings.spacing + 1e-6)) for side in self.sides(settings)])
        )

    def sides(self, settings: FluidSettings) -> list[float]:
        """Of the room inside, m: in the plane without its depth."""
        flat = settings.dimensions == 2
        return [self.width, self.height] if flat else [self.width, self.depth, self.height]


def rows_in(side: float, settings: FluidSettings) -> int:
    """How many particles stand side by side along so many metres."""
    return math.floor(side / settings.spacing + 1e-6)


def turned(angle: Float[Array, "*#b"], offsets: Float[Array, "*#b 3"]) -> Float[Array, "*b 3"]:
    """Offsets (m) turned about y by ``angle`` (rad): from upright towards +x."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y, z = offsets[..., 0], offsets[..., 1], offsets[..., 2]
    across, along = cosine * x + sine * z, cosine * z - sine * x
    return jnp.stack([across, jnp.broadcast_to(y, across.shape), along], axis=-1)


def boxes_of(container: Container, place: Float[Array, "3"], angle: Float[Array, ""]) -> Obstacles:
    """A container's five boxes: its inner floor's middle at ``place`` (m), tilted by ``angle`` (rad)."""
    half = angle / 2
    zero = jnp.zeros_like(half)
    turn = jnp.stack([jnp.cos(half), zero, jnp.sin(half), zero])
    offsets = jnp.asarray(container.centres)
    return Obstacles(
        kind=jnp.full(5, int(ShapeKind.BOX), jnp.int32),
        centre=place + turned(jnp.broadcast_to(angle, 5), offsets),
        quaternion=jnp.broadcast_to(turn, (5, 4)),
        half_size=jnp.asarray(container.half_sizes),
        active=jnp.ones(5, bool),
    )


def inside(
    container: Container, place: Float[Array, "3"], angle: Float[Array, ""], positions: Float[Array, "P D"]
) -> Bool[Array, "P"]:
    """Which particles are in the room between a container's walls, however it is tilted."""
    flat = positions.shape[1] == 2
    points = jnp.insert(positions, 1, 0.0, axis=1) if flat else positions
    own = turned(-angle, points - place)
    within = (jnp.abs(own[:, 0]) <= container.width / 2) & (jnp.abs(own[:, 1]) <= container.depth / 2)
    return within & (own[:, 2] >= 0) & (own[:, 2] <= container.height)


def filled(
    container: Container, place: tuple[float, float, float], count: int, settings: FluidSettings
) -> Float[np.ndarray, "P D"]:
    """Places (m) of ``count`` particles in rows on the floor of an upright container.

    Raises:
        ValueError: for no particles, a container that is smaller than one, or more than fit.
    """
    if count < 1:
        raise ValueError(
            f"the container is to hold {count} particles, expected at least 1: it would be empty"
        )
    sides = container.sides(settings)
    each = [rows_in(side, settings) for side in sides]
    if min(each) < 1:
        raise ValueError(
            f"a container of {' by '.join(f'{side:g}' for side in sides)} m is smaller than a particle of "
            f"{settings.spacing:g} m: expected every side at least as long"
        )
    if count > int(np.prod(each)):
        raise ValueError(
            f"{count} particles of {settings.spacing:g} m do not fit into a container of "
            f"{' by '.join(f'{side:g}' for side in sides)} m: expected at most {int(np.prod(each))}"
        )
    rows = np.indices(each[::-1]).reshape(len(each), -1).T[:count, ::-1]  # x fastest, layer upon layer
    gaps = [(side - settings.spacing * many) / many for side, many in zip(sides[:-1], each[:-1], strict=True)]
    pitch = np.array([settings.spacing + gap for gap in gaps] + [settings.spacing])
    low = np.array([-side / 2 for side in sides[:-1]] + [0.0])
    origin = np.array([place[0], place[2]] if settings.dimensions == 2 else place)
    return (origin + low + (rows + 0.5) * pitch).astype(np.float32)
