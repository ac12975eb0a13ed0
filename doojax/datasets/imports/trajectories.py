"""Arrays of trajectories that doojax did not make, as all fields that a data set has."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.datasets.collect import STATES
from doojax.datasets.manifest import Field
from doojax.geometry.sdf import signed_distance
from doojax.simulation.scenes import Scene
from doojax.tasks.base import Task
from doojax.types import Obstacles

OBSTACLES = tuple(f"obstacle_{name}" for name in Obstacles.__annotations__)
NEEDED, OPTIONAL = ("points", "grippers"), ("actions", "environment", *OBSTACLES)


def stored(task: Task, given: Mapping[str, np.ndarray], source: Path) -> dict[str, np.ndarray]:
    """All fields of the data set.

    Raises:
        ValueError: for what is missing, not finite, or of another shape than the task's.
    """
    absent = [name for name in NEEDED if name not in given]
    if absent:
        raise ValueError(f"{source} lacks {' and '.join(absent)}")
    links, hands = task.scene.links, task.grippers
    count, states = given["points"].shape[:2] if given["points"].ndim == 4 else (0, 0)
    if count < 1 or states < 2:
        shape = given["points"].shape
        raise ValueError(f"points has the shape {shape}, expected [K, T+1, {links}, 3] with T at least 1")
    shapes = {
        "points": (count, states, links, 3),
        "grippers": (count, states, hands, 3),
        "actions": (count, states - 1, hands, 3),
        "environment": (count,),
    }
    moves = np.diff(given["grippers"], axis=1)
    every: dict[str, Any] = {name: given[name] for name in NEEDED}
    every |= {"actions": moves, "environment": np.arange(count), **given, **_obstacles(task, given)}
    kinds = {"environment": np.int32, "obstacle_kind": np.int32, "obstacle_active": bool}
    for name, values in every.items():
        shape = shapes.get(name, (count, *values.shape[1:]))
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(
                f"{source}: {name} has the shape {list(values.shape)}"
                f"{'' if np.isfinite(values).all() else ' and values that are not finite'}, expected finite "
                f"numbers of the shape {list(shape)}, as of the task {task.name}"
            )
        every[name] = values.astype(kinds.get(name, np.float32))
    obstacles = Obstacles(**{name.removeprefix("obstacle_"): jnp.asarray(every[name]) for name in OBSTACLES})
    points, hands = jnp.asarray(every["points"]), jnp.asarray(every["grippers"])
    every["clearance"] = np.asarray(_clearance(task.scene, obstacles, points, hands))
    every["stretch"] = np.zeros((count, states), np.float32)
    every["faults"] = np.zeros((count, states - 1), np.int32)
    return every


def _obstacles(task: Task, given: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Those that are given, or as many inactive ones as the task has."""
    absent = [name for name in OBSTACLES if name not in given]
    if absent and len(absent) < len(OBSTACLES):
        raise ValueError(f"of the obstacles {', '.join(absent)} is missing: expected all of them, or none")
    if not absent:
        return {}
    count, most = len(given["points"]), max(sum(len(one.shapes) for one in task.scene.obstacles), 1)
    none = Obstacles(
        kind=jnp.zeros((count, most), jnp.int32),
        centre=jnp.zeros((count, most, 3)),
        quaternion=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count, most, 1)),
        half_size=jnp.ones((count, most, 3)),
        active=jnp.zeros((count, most), bool),
    )
    return {f"obstacle_{name}": np.asarray(values) for name, values in vars(none).items()}


@partial(jax.jit, static_argnums=0)
def _clearance(
    scene: Scene,
    obstacles: Obstacles,
    points: Float[Array, "K T1 N 3"],
    hands: Float[Array, "K T1 G 3"],
) -> Float[Array, "K T1"]:
    """Least distance (m) of the links' centres and of the hands to an obstacle."""

    def one(own: Obstacles, points: Array, hands: Array) -> Array:
        rope = signed_distance(own, points).min(-1) - scene.rope_part.parameters.radius
        radii = jnp.array([hand.radius for hand in scene.grippers])
        return jnp.minimum(rope, (signed_distance(own, hands) - radii).min(-1))

    return jax.vmap(one)(obstacles, points, hands)


def field_of(name: str, values: np.ndarray) -> Field:
    """How a data set describes these values [K, ...]."""
    units = {**STATES, "actions": ("m", "displacements of the hands"), "clearance": ("m", "to an obstacle")}
    unit, text = units.get(name, ("1", name.replace("_", " ")))
    return Field(values.shape[1:], values.dtype.name, unit, text)
