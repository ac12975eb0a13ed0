"""MuJoCo C's own batch function and nothing around it: the peer that the engines are measured against."""

import copy
from collections.abc import Callable

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float
from mujoco.rollout import Rollout

from doojax.simulation.build import build_model
from doojax.simulation.engines.mujoco import write_state
from doojax.simulation.layout import Layout
from doojax.simulation.scenes import Scene
from doojax.simulation.state import SimState


def bare_rollout(
    scene: Scene, states: SimState, actions: Float[Array, "B G 3"], threads: int
) -> Callable[[], np.ndarray]:
    """A function that runs `mujoco.rollout` for one control period of B elements, all else made in advance.

    It returns the states of every physics step, ``[B, S, 1 + nq + nv]``.
    """
    model, host = build_model(scene), jax.tree.map(np.asarray, states)
    layout = Layout.of(scene, model)
    models = []
    for index in range(len(host.qpos)):
        models.append(copy.copy(model))
        write_state(models[-1], layout, jax.tree.map(lambda leaf, i=index: leaf[i], host))
    initial = np.concatenate([np.zeros((len(models), 1)), host.qpos, host.qvel], axis=1)
    driven, commanded = initial[:, 1 + layout.driven], np.asarray(host.commanded)
    controls, _ = scene.driver.drive(scene, driven, commanded, np.asarray(actions, dtype=float), xp=np)
    pool, data = Rollout(nthread=threads), [mujoco.MjData(model) for _ in range(threads)]
    return lambda: pool.rollout(models, data, initial, controls, chunk_size=1)[0]
