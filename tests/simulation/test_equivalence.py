"""MJX's implementations beside MuJoCo C, from the same states and actions."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.simulation.engines import make_simulator
from tests.simulation.scenes import no_start, planar_scene, straight_states

needs_warp = pytest.mark.skipif(
    importlib.util.find_spec("warp") is None, reason="pip install 'doojax[warp]' runs this"
)


def largest_gap(engine: str, batch: int) -> float:
    """Metres between an engine's rope points and MuJoCo C's, after a second of free motion."""
    scene = planar_scene()
    angle = np.linspace(0, 2 * np.pi, batch, endpoint=False)
    move = 0.12 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    actions = jnp.asarray(move[:, None, None], dtype=jnp.float32)
    states = straight_states(scene, batch)
    points = {}
    for name in ("mujoco", engine):
        simulator = make_simulator(scene, start=no_start, engine=name)
        _, seen = simulator.rollout(states, actions)
        assert not np.asarray(seen.faults).any()
        points[name] = seen.states.points[:, -1]
    return float(jnp.linalg.norm(points["mujoco"] - points[engine], axis=-1).max())


@needs_warp
@pytest.mark.slow
def test_warp_agrees_within_a_millimetre_after_a_second_on_a_cpu():
    assert largest_gap("warp", 8) < 1e-3


@pytest.mark.gpu
@pytest.mark.parametrize("engine", ["mjx", pytest.param("warp", marks=needs_warp)])
@pytest.mark.parametrize("batch", [256, 2048, 16384])
def test_a_gpu_agrees_within_a_millimetre_after_a_second(engine, batch):
    assert jax.default_backend() == "gpu"
    assert largest_gap(engine, batch) < 1e-3
