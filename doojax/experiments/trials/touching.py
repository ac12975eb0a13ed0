"""What a rope and its grippers touch, by name."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doojax.experiments.trials.records import Look, solid_of
from doojax.geometry.sdf import signed_distances
from doojax.types import Obstacles, ShapeKind

CONTACT = 0.005  # m between two surfaces that count as touching
BETWEEN = 4  # samples of each link
BLOCK = 512  # points at once: always as many, so that nothing is compiled anew
TABLE = 0.25  # m, half the least width of what counts as a table top, if it is flat, too


def obstacle_names(obstacles: Obstacles) -> list[str]:
    """What obstacles are called, such as "box 3"; numbers count all of a scene from 0 on."""
    kinds, sizes = np.asarray(obstacles.kind), np.asarray(obstacles.half_size)
    return [
        f"{'table' if is_table(size) else ShapeKind(int(kind)).name.lower()} {number}"
        for number, (kind, size) in enumerate(zip(kinds, sizes, strict=True))
    ]


def is_table(half_size: Float[np.ndarray, "3"]) -> bool:
    """Is this something to put things on: half a metre wide and more, and flat?"""
    return bool(min(half_size[:2]) > max(TABLE, 3 * half_size[2]))


def gaps(
    obstacles: Obstacles, points: Float[np.ndarray, "N 3"], grippers: Float[np.ndarray, "G 3"], look: Look
) -> Float[np.ndarray, "M"]:
    """Distances (m) of each obstacle to the surface of a rope and its grippers, negative inside.

    Along straight links, and half a link beyond the rope's ends where it goes on there.
    """
    points, grippers = solid_of(points, grippers, look)
    part = np.linspace(0, 1, BETWEEN, endpoint=False)[:, None, None]
    curve = np.concatenate([(points[:-1] + part * np.diff(points, axis=0)).reshape(-1, 3), points[-1:]])
    if look.rope_end and len(points) > 1:
        ends = np.stack([points[0] - points[1], points[-1] - points[-2]])
        ends *= look.rope_end / np.maximum(np.linalg.norm(ends, axis=-1, keepdims=True), 1e-9)
        curve = np.concatenate([curve, points[[0, -1]] + ends])
    places = np.concatenate([curve, grippers]).astype(np.float32)
    radius = np.repeat([look.rope_radius, look.gripper_radius], [len(curve), len(grippers)])
    return (_distances(obstacles, places) - radius[:, None]).min(0)


def touched(gap: Float[np.ndarray, "M"], names: Sequence[str], within: float = CONTACT) -> list[str]:
    """The obstacles whose gap (m) is small enough, the least first; tables only where nothing else is."""
    near = [names[int(index)] for index in np.argsort(gap, kind="stable") if gap[index] < within]
    return [name for name in near if not name.startswith("table")] or near


def _distances(obstacles: Obstacles, places: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K M"]:
    padded = np.pad(places, ((0, -len(places) % BLOCK), (0, 0)))
    blocks = [np.asarray(_jitted(obstacles, jnp.asarray(block))) for block in padded.reshape(-1, BLOCK, 3)]
    return np.concatenate(blocks)[: len(places)]


_jitted = jax.jit(signed_distances)
