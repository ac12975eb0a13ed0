"""How hard a scene is, without looking at any method: is the straight way blocked, how narrow is the best."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import ndimage

from doojax.geometry.sdf import signed_distance
from doojax.geometry.segment_sdf import segment_signed_distance
from doojax.tasks.base import Box
from doojax.types import Obstacles

CELL = {1: 0.02, 2: 0.02, 3: 0.04}  # m, of the grid on which ways are looked for, by dimensions
HALVINGS = 12  # of the bracket around a bottleneck


def difficulty(
    obstacles: Obstacles, begin: Float[np.ndarray, "S 3"], goal: Float[np.ndarray, "S 3"], workspace: Box
) -> dict[str, Float[np.ndarray, "S"]]:
    """Measures of S scenes for a point that is to move from ``begin`` to ``goal``, metres.

    Returns:
        ``distance`` in a straight line; ``straight_clearance``, the least distance to an obstacle on that
        line, negative inside; ``goal_clearance``, that at the goal; and ``bottleneck``, the radius of the
        largest ball that could roll from ``begin`` to ``goal`` within the workspace, 0 where none could, as
        found on a grid.
    """
    straight, at_goal = _clearances(obstacles, jnp.asarray(begin), jnp.asarray(goal))
    grid = _grid(workspace)
    widest = np.zeros(len(begin))
    for scene, clearance in enumerate(_grid_clearances(obstacles, jnp.asarray(grid.reshape(-1, 3)))):
        cells = [_cell(point, workspace, grid.shape[:-1]) for point in (begin[scene], goal[scene])]
        widest[scene] = bottleneck(np.asarray(clearance).reshape(grid.shape[:-1]), *cells)
    return {
        "distance": np.linalg.norm(goal - begin, axis=-1),
        "straight_clearance": np.asarray(straight),
        "goal_clearance": np.asarray(at_goal),
        "bottleneck": widest,
    }


def bottleneck(clearance: np.ndarray, begin: tuple[int, ...], end: tuple[int, ...]) -> float:
    """The largest clearance that a way between two cells of a grid can keep; 0 where there is no way."""
    low, high = 0.0, float(min(clearance[begin], clearance[end]))
    if not _joined(clearance > 0, begin, end):
        return 0.0
    if _joined(clearance >= high, begin, end):
        return high
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if _joined(clearance > middle, begin, end) else (low, middle)
    return low


def _joined(free: np.ndarray, begin: tuple[int, ...], end: tuple[int, ...]) -> bool:
    labels = np.asarray(ndimage.label(free, structure=np.ones((3,) * free.ndim))[0])  # pyright: ignore
    return bool(labels[begin] == labels[end] != 0)


def _grid(workspace: Box) -> Float[np.ndarray, "X Y Z 3"]:
    extent = np.array(workspace.high) - np.array(workspace.low)
    counts = np.round(extent / CELL[int((extent > 0).sum())]).astype(int) + 1
    axes = map(np.linspace, workspace.low, workspace.high, counts)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)


def _cell(point: np.ndarray, workspace: Box, shape: tuple[int, ...]) -> tuple[int, ...]:
    low, high, last = np.array(workspace.low), np.array(workspace.high), np.array(shape) - 1
    fraction = (point - low) / np.maximum(high - low, 1e-9)
    return tuple(np.clip(np.round(fraction * last), 0, last).astype(int).tolist())


@jax.jit
def _clearances(
    obstacles: Obstacles, begin: Float[Array, "S 3"], goal: Float[Array, "S 3"]
) -> tuple[Float[Array, "S"], Float[Array, "S"]]:
    return jax.vmap(segment_signed_distance)(obstacles, begin, goal), jax.vmap(signed_distance)(
        obstacles, goal
    )


@jax.jit
def _grid_clearances(obstacles: Obstacles, cells: Float[Array, "C 3"]) -> Float[Array, "S C"]:
    return jax.lax.map(lambda one: signed_distance(one, cells), obstacles)
