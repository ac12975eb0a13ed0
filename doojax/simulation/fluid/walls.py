"""Boxes that hold a fluid, and move: exact distances, what they do to densities, and how they push."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from doojax.geometry.sdf import signed_distances_and_gradients
from doojax.types import Obstacles

MARGIN = 1e-5  # m, that a particle keeps beyond its radius, for rounding
UNROLLED = 24  # walls, at most
PASSES = 2  # of the last, exact push out of walls


class Walls(eqx.Module):
    """M boxes where they are at the end of a step, and how each moves."""

    obstacles: Obstacles  # [M]
    velocity: Float[Array, "M 3"]  # m/s, of what is at the centre
    spin: Float[Array, "M 3"]  # rad/s, about the centre


def still(obstacles: Obstacles) -> Walls:
    """Walls that do not move."""
    nothing = jnp.zeros_like(obstacles.centre)
    return Walls(obstacles, nothing, nothing)


class Near(eqx.Module):
    """What P particles know of M walls: exact where they were looked at, nearby the plane through there."""

    distance: Float[Array, "M P"]  # m
    normal: list[Float[Array, "M P"]]  # D of them
    at: list[Float[Array, "P"]]  # m, where


def coordinates(positions: Float[Array, "P D"]) -> list[Float[Array, "P"]]:
    """x, y, z; in the plane, y is 0."""
    x, z = positions[:, 0], positions[:, -1]
    return [x, positions[:, 1] if positions.shape[1] == 3 else jnp.zeros_like(x), z]


def look(walls: Walls, positions: Float[Array, "P D"]) -> Near:
    """Distances to all walls, and away from them."""
    distance, *normal = signed_distances_and_gradients(walls.obstacles, *coordinates(positions))
    flat = positions.shape[1] == 2
    own = [normal[0], normal[2]] if flat else normal
    return Near(distance, own, [positions[:, axis] for axis in range(positions.shape[1])])


def distances(near: Near, x: list[Float[Array, "P"]]) -> Float[Array, "M P"]:
    """To all walls from places near those that were looked at, m."""
    moved = [one - old for one, old in zip(x, near.at, strict=True)]
    return near.distance + sum(n * step for n, step in zip(near.normal, moved, strict=True))


def kept_out(near: Near, x: list[Float[Array, "P"]], radius: float) -> list[Float[Array, "P"]]:
    """Places moved out of one wall after the other, as planes."""

    def push(index: int | Array, x: list[Array]) -> list[Array]:
        normal = [one[index] for one in near.normal]
        moved = [one - old for one, old in zip(x, near.at, strict=True)]
        gap = near.distance[index] + sum(n * step for n, step in zip(normal, moved, strict=True))
        out = jnp.maximum(radius - gap, 0.0)
        return [one + out * n for one, n in zip(x, normal, strict=True)]

    count = near.distance.shape[0]
    if count > UNROLLED:
        return jax.lax.fori_loop(0, count, push, x)
    for index in range(count):  # one operation to XLA, where a loop would be dozens
        x = push(index, x)
    return x


def pushed_out(
    walls: Walls, positions: Float[Array, "P D"], radius: float
) -> tuple[Float[Array, "P D"], Bool[Array, "P"]]:
    """Places at least ``radius`` from every wall, by exact distances, and which of them had no room.

    Those are inside of a wall even before the last push: walls come together there.
    """

    def push(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        positions, _ = carry
        near = look(walls, positions)
        nearest = jnp.argmin(near.distance, axis=0)[None]
        gap, *normal = (jnp.take_along_axis(one, nearest, 0)[0] for one in (near.distance, *near.normal))
        out = jnp.maximum(radius + MARGIN - gap, 0.0)
        return positions + out[:, None] * jnp.stack(normal, axis=1), gap < 0

    begun = positions, jnp.zeros(len(positions), bool)
    return jax.lax.fori_loop(0, PASSES, push, begun) if walls.obstacles.kind.shape[0] else begun


def velocities(walls: Walls, near: Near) -> list[Float[Array, "M P"]]:
    """How fast each wall moves where it is nearest to each particle, m/s."""
    flat = len(near.at) == 2
    place = [near.at[0], jnp.zeros_like(near.at[0]) if flat else near.at[1], near.at[-1]]
    arm = [one[None] - walls.obstacles.centre[:, axis, None] for axis, one in enumerate(place)]
    spin = [walls.spin[:, axis, None] for axis in range(3)]
    turned = [
        spin[1] * arm[2] - spin[2] * arm[1],
        spin[2] * arm[0] - spin[0] * arm[2],
        spin[0] * arm[1] - spin[1] * arm[0],
    ]
    found = [walls.velocity[:, axis, None] + turned[axis] for axis in range(3)]
    return [found[0], found[2]] if flat else found
