"""The mechanical energy of a rope, from states of any engine."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doojax.benchmarks.physics.cases import engine_of, stacked
from doojax.simulation.scenes import Scene
from doojax.simulation.state import SimState

EPSILON = 1e-3  # s, over which positions are moved along their velocities


def energy(scene: Scene, states: list[SimState]) -> Float[np.ndarray, "T B"]:
    """Kinetic, gravitational and bending energy of a capsule chain (J) in T batches of B states.

    Links are rods whose spin about their own axis is left out. Velocities are central differences of
    positions along `SimState.qvel`. A hand's grip gives way a little under load: heights are those above
    where the first hand's grip has got to, so that this does not count as a loss. Not finite for a rope that
    burst.
    """
    with np.errstate(all="ignore"):
        (before, behind, _), (points, axes, given), (after, ahead, _) = (
            _observed(scene, states, step) for step in (-EPSILON, 0.0, EPSILON)
        )
    links, rope = scene.links, scene.rope_part.parameters
    mass, pitch = rope.mass / links, rope.length / links
    speed, turning = (after - before) / (2 * EPSILON), (ahead - behind) / (2 * EPSILON)
    kinetic = mass / 2 * ((speed**2).sum(-1) + pitch**2 / 12 * (turning**2).sum(-1)).sum(-1)
    height = mass * scene.gravity * (points[..., 2] + given[..., None]).sum(-1)
    cosine = np.clip((axes[..., 1:, :] * axes[..., :-1, :]).sum(-1), -1, 1)
    bending = rope.bending_stiffness / pitch / 2 * (np.arccos(cosine) ** 2).sum(-1)
    return kinetic + height + bending


def _observed(scene: Scene, states: list[SimState], step: float) -> tuple[np.ndarray, ...]:
    """After ``step`` seconds at constant velocities: centres and unit axes of the links [T, B, N, 3], and how
    far the grip of hand 0 has sunk below it [T, B]."""
    moved = stacked([replace(state, qpos=_moved(scene, state, step)) for state in states])
    seen = engine_of(scene, "mujoco").observations(moved)
    axes = np.asarray(seen.half_links, dtype=float)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    sunk = np.asarray(seen.hands - seen.hold_points, dtype=float)[:, 0, 2]
    shape = (len(states), -1, *axes.shape[1:])
    points = np.asarray(seen.state.points, dtype=float)
    return points.reshape(shape), axes.reshape(shape), sunk.reshape(shape[:2])


def _moved(scene: Scene, state: SimState, step: float) -> jnp.ndarray:
    qpos, qvel = np.asarray(state.qpos, dtype=float), np.asarray(state.qvel, dtype=float)
    place = qpos[:, :3] + step * qvel[:, :3]
    spin = step * qvel[:, 3:6]  # in the link's own frame
    half = np.linalg.norm(spin, axis=1, keepdims=True) / 2
    turn = np.concatenate([np.cos(half), np.sinc(half / np.pi) * spin / 2], axis=1)
    w, x, y, z = np.moveaxis(qpos[:, 3:7], 1, 0)
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    rest = qpos[:, 7:] + step * qvel[:, 6:]
    return jnp.asarray(
        np.concatenate([place, np.einsum("ijb,bj->bi", matrix, turn), rest], axis=1), dtype=jnp.float32
    )
