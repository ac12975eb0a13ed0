"""The classifier from distances: what its network sees, and its convolution, beside plain ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.geometry import signed_distance
from doojax.learning.presets import classifier_preset
from doojax.models.classifier import (
    FAR,
    NEAR,
    ChainConvolution,
    ClassifierConfig,
    DistanceClassifier,
)
from doojax.models.local import chain_of, local_frame
from doojax.tasks import make_task
from doojax.types import Obstacles, RopeState, Transition
from tests.calls import called

OBSTACLES = Obstacles(
    kind=jnp.array([0, 1, 2]),
    centre=jnp.array([[0.9, 0.1, 0.85], [0.7, -0.2, 0.75], [0.85, 0.0, 0.7]]),
    quaternion=jnp.array([[1.0, 0, 0, 0], [0.6, 0.8, 0, 0], [0.8, 0, 0.6, 0]]),
    half_size=jnp.array([[0.03, 0.05, 0.02], [0.02, 0.02, 0.1], [0.03, 0.03, 0.05]]),
    active=jnp.ones(3, dtype=bool),
)


def transition(points: int, grippers: int) -> tuple[RopeState, jax.Array, RopeState]:
    """A bent rope whose ends are moved by different actions."""
    t = jnp.linspace(0, 1, points)
    rope = jnp.stack([0.8 + 0.1 * jnp.sin(3 * t), 0.5 * t - 0.25, 0.8 + 0.15 * (t - 0.5) ** 2], axis=-1)
    action = jnp.array([[0.03, -0.02, 0.05], [-0.01, 0.04, 0.02]])
    moved = rope + (1 - t)[:, None] * action[0] + t[:, None] * action[1]
    hands = jnp.array([-1, 0])[:grippers]
    moves = jnp.array([1, 0])[:grippers]
    return RopeState(rope, rope[hands]), action[moves], RopeState(moved, moved[hands])


@jax.jit
def around(place):
    """Distances of points, and which way these grow."""
    away = jax.vmap(jax.grad(signed_distance, argnums=1), (None, 0))(OBSTACLES, place)
    return signed_distance(OBSTACLES, place)[:, None], away


@pytest.mark.parametrize(
    "points, grippers, moments, midpoints",
    [pytest.param(25, 2, 3, True, marks=pytest.mark.slow), (10, 1, 2, False)],
)
def test_the_network_sees_per_point_its_place_motion_and_distances_at_each_moment(
    points, grippers, moments, midpoints
):
    # Trained weights depend on this order.
    config = ClassifierConfig(grippers, "gripper", width=8, moments=moments, midpoints=midpoints)
    classifier = DistanceClassifier(config, key=jax.random.key(0))
    before, action, after = transition(points, grippers)
    step = Transition(before, action, after, jnp.array(0.02))
    chain, whole = eqx.filter_jit(classifier.inputs)(OBSTACLES, step)

    frame = called(local_frame, before, action, "gripper", "canonical")
    begin, end = chain_of(before, midpoints), chain_of(after, midpoints)
    expected = [
        np.linspace(-1, 1, len(begin))[:, None],
        frame.points_in(begin) / 0.2,
        frame.vectors_in(end - begin) / 0.05,
    ]
    for part in np.linspace(0, 1, moments):
        place = begin + part * (end - begin)
        distance, away = around(place)
        fading = jnp.exp(-jnp.maximum(distance, 0) / FAR)
        expected += [jnp.tanh(distance / NEAR), jnp.tanh(distance / FAR), fading * frame.vectors_in(away)]
    np.testing.assert_allclose(chain, np.concatenate(expected, axis=1), atol=2e-5)
    doubt = np.log(0.0201) + 3
    np.testing.assert_allclose(whole, [*np.ravel(frame.vectors_in(action)) / 0.1, doubt], atol=1e-5)
    assert chain.shape[1] == config.features and len(whole) == config.globals


@pytest.mark.parametrize("name", ["rope_dragging", "dual_gripper"])
def test_every_preset_sees_what_the_rope_passes_between_start_and_end(name):
    task = make_task(name)
    for preset in ("quick", "thesis"):
        network = classifier_preset(preset, task).network
        assert network.moments >= 3 and network.features == 7 + 5 * network.moments


@pytest.mark.parametrize("length", [1, 2, 7])
def test_the_convolution_is_one_layer_over_each_point_and_its_neighbours(length):
    convolution = ChainConvolution(5, key=jax.random.key(1))
    x = jax.random.normal(jax.random.key(2), (length, 5))
    padded = np.pad(x, ((1, 1), (0, 0)))
    windows = np.concatenate([padded[:-2], x, padded[2:]], axis=1)
    layer = convolution.linear
    expected = x + np.maximum(windows @ layer.weight.T + layer.bias, 0)
    np.testing.assert_allclose(eqx.filter_jit(convolution)(x), expected, atol=1e-6)
