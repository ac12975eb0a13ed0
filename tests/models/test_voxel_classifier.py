"""The classifier that sees voxels: its rasters, its convolutions, what it is blind to, whether it learns."""

from dataclasses import asdict, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from doojax.geometry.voxels import Grid, gaussian_raster, inverse_log_raster
from doojax.learning.checkpoints import Header, load_model, save_model
from doojax.models import Reliability
from doojax.models.rasters import Encoder, ViewConfig, convolved, rasterise, view
from doojax.models.voxel_classifier import VoxelClassifier, VoxelClassifierConfig
from doojax.types import Obstacles, ShapeKind, Transition
from tests.calls import called

from .voxel_examples import DEEP, FLAT, box, rope


@pytest.fixture(scope="module")
def classifier():
    return VoxelClassifier(VoxelClassifierConfig(3, FLAT, width=16), key=jax.random.key(1))


@pytest.fixture(scope="module")
def logit():
    return eqx.filter_jit(lambda model, obstacles, *step: model.logit(obstacles, Transition(*step)))


def numpy_occupancy(obstacles, centres, reach):
    """Which centres lie within ``reach`` of a turned box or an upright cylinder, worked out in numpy."""
    occupied = np.zeros(centres.shape[:-1], bool)
    for number in range(obstacles.kind.shape[0]):
        if not obstacles.active[number]:
            continue
        half = np.asarray(obstacles.half_size[number], float)
        turn = Rotation.from_quat(np.asarray(obstacles.quaternion[number]), scalar_first=True)
        local = turn.inv().apply((centres - np.asarray(obstacles.centre[number])).reshape(-1, 3))
        if obstacles.kind[number] == ShapeKind.CYLINDER:
            local = np.stack([np.hypot(local[:, 0], local[:, 1]), 0 * local[:, 0], local[:, 2]], axis=1)
        outside = np.linalg.norm(local - np.clip(local, -half, half), axis=1)
        occupied |= (outside <= reach).reshape(occupied.shape)
    return occupied


def test_the_voxels_are_what_numpy_says():
    obstacles = Obstacles(
        kind=jnp.array([ShapeKind.BOX, ShapeKind.CYLINDER, ShapeKind.BOX], jnp.int32),
        centre=jnp.array([[0.1, 0.03, 0.4], [-0.17, -0.1, 0.52], [0.0, 0.0, 0.5]]),
        quaternion=jnp.array([[0.8, 0.0, 0.6, 0.0], [1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]),
        half_size=jnp.array([[0.07, 0.11, 0.03], [0.06, 0.06, 0.13], [0.2, 0.2, 0.2]]),
        active=jnp.array([True, True, False]),
    )
    state = rope(0.2, 0.03, 0.5, points=5, grippers=2)
    voxels = np.asarray(called(rasterise, obstacles, state, DEEP))

    assert voxels.shape == (12, 12, 12, DEEP.inputs)
    middle = np.asarray(state.points).mean(0)
    steps = (np.arange(12) - 5.5) * 0.05
    z, x, y = np.meshgrid(*(steps + middle[axis] for axis in (2, 0, 1)), indexing="ij")
    centres = np.stack([x, y, z], axis=-1)
    expected = numpy_occupancy(obstacles, centres, 0.025)
    assert 20 < expected.sum() < 400
    certain = numpy_occupancy(obstacles, centres, 0.0251) == numpy_occupancy(obstacles, centres, 0.0249)
    assert certain.mean() > 0.9  # the others rounding may put on either side
    np.testing.assert_array_equal(voxels[certain, 0], expected[certain])

    for channel, points in enumerate((state.points, state.grippers[:1], state.grippers[1:]), start=1):
        squares = ((centres[..., None, :] - np.asarray(points)) ** 2).sum(-1)
        np.testing.assert_allclose(voxels[..., channel], np.exp(-2000 * squares).max(-1), atol=1e-5)


@pytest.mark.parametrize(
    ("raster", "of"), [("gaussian", gaussian_raster), ("inverse log", inverse_log_raster)]
)
def test_both_kinds_of_raster_are_those_of_the_geometry(raster, of):
    state = rope(0.1, -0.2, 0.3, points=4, grippers=2)
    grid = Grid(state.points.mean(0) - 0.3, 0.05, (12, 12, 12))
    voxels = called(rasterise, box(9, 9, 9), state, replace(DEEP, raster=raster))
    expected = np.moveaxis(called(of, state.points, grid), 2, 0)
    np.testing.assert_allclose(voxels[..., 1], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("preset", "grippers", "features"),
    [("thesis", 1, 10_400), ("thesis", 2, 702), ("quick", 1, 4 * 4 * 2 * 8), ("quick", 2, 3**3 * 8)],
)
def test_the_convolutions_leave_as_many_features_as_documented(preset, grippers, features):
    config = view(preset, grippers)
    assert config.features == features
    encoder = eqx.filter_eval_shape(lambda: Encoder(config, key=jax.random.key(0)))
    out = eqx.filter_eval_shape(
        lambda encoder, obstacles, state: encoder(obstacles, state),
        encoder,
        box(0, 0, 0),
        rope(points=10, grippers=grippers),
    )
    assert out.shape == (features,)


@pytest.mark.parametrize("config", [FLAT, DEEP], ids=["kernels 3x3x1", "kernels 3x3x3"])
def test_the_encoder_is_a_convolution_over_three_axes_with_pools(config):
    """The same numbers as XLA's own three-dimensional convolution and its windowed maximum."""
    encoder = Encoder(config, key=jax.random.key(3))
    voxels = jax.random.normal(jax.random.key(4), (config.up, config.across, config.across, config.inputs))
    expected = voxels[None]
    for kernel, bias in zip(encoder.kernels, encoder.biases, strict=True):
        layers = jnp.stack(jnp.split(kernel, config.kernel_up, axis=2))
        expected = jax.lax.conv_general_dilated(
            expected, layers, (1, 1, 1), "VALID", dimension_numbers=("NDHWC", "DHWIO", "NDHWC")
        )
        window = (1, config.pool_up, 2, 2, 1)
        expected = jax.lax.reduce_window(
            jax.nn.relu(expected + bias), -jnp.inf, jax.lax.max, window, window, "VALID"
        )
    assert expected.size == config.features
    np.testing.assert_allclose(called(encoder.convolve, voxels), expected.reshape(-1), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("batched_kernel", [None, 0])
def test_a_convolution_and_both_its_derivatives_are_those_of_jax(batched_kernel):
    random = np.random.default_rng(3)
    few = () if batched_kernel is None else (6,)
    shapes = [(6, 2, 7, 5, 3), (*few, 3, 3, 3, 4), (6, 2, 5, 3, 4)]
    arrays = [jnp.asarray(random.normal(size=shape), jnp.float32) for shape in shapes]
    voxels_dot, kernel_dot = (jnp.asarray(random.normal(size=shape), jnp.float32) for shape in shapes[:2])

    def plain(voxels, kernel):
        return jax.lax.conv_general_dilated(
            voxels, kernel, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    @partial(jax.jit, static_argnums=0)
    def everything(one, voxels, kernel, weights):
        many = jax.vmap(one, (0, batched_kernel))
        value, along = jax.jvp(many, (voxels, kernel), (voxels_dot, kernel_dot))
        return value, along, jax.grad(lambda *both: (weights * many(*both)).sum(), (0, 1))(voxels, kernel)

    ours, theirs = (jax.tree.leaves(everything(one, *arrays)) for one in (convolved, plain))
    for found, expected in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_what_is_encoded_does_not_depend_on_where_in_the_world_it_is(classifier):
    encode = eqx.filter_jit(lambda model, obstacles, state: model.encode(obstacles, state))
    here = encode(classifier, box(0.095, 0.023, 0.02), rope(0.0, 0.0, 0.02))
    there = encode(classifier, box(0.845, -0.227, 0.27), rope(0.75, -0.25, 0.27))
    np.testing.assert_allclose(here, there, atol=2e-3)
    nearer = encode(classifier, box(0.845, -0.127, 0.27), rope(0.75, -0.25, 0.27))
    assert np.abs(nearer - here).max() > 0.1


def test_only_what_reaches_into_the_view_counts(classifier, logit):
    """The view ends 0.14 m from the gripper, which moves from x = 0 to 0.05; the box is 0.05 m thick."""
    move = (jnp.array([[0.05, 0.0, 0.0]]), rope(0.05), jnp.array(0.1))
    far, farther = box(0.26, 0.0, 0.02), box(2.0, 0.0, 0.02)
    seen_at_the_end = box(0.22, 0.0, 0.02)
    parked = box(0.1, 0.0, 0.02, active=False)
    values = [float(logit(classifier, scene, rope(), *move)) for scene in (far, farther, parked)]
    assert values[0] == values[1] == values[2]
    assert float(logit(classifier, seen_at_the_end, rope(), *move)) != values[0]


def test_every_argument_counts(classifier, logit):
    given = (box(0.1, 0.1, 0.02), rope(), jnp.array([[0.05, 0.0, 0.0]]), rope(0.05), jnp.array(0.1))
    others = (
        box(0.1, 0.05, 0.02),
        rope(y=0.01),
        jnp.array([[0.0, 0.05, 0.0]]),
        rope(0.05, 0.1),
        jnp.array(0.2),
    )
    value = float(logit(classifier, *given))
    for position, other in enumerate(others):
        changed = (*given[:position], other, *given[position + 1 :])
        assert abs(float(logit(classifier, *changed)) - value) > 1e-5, f"argument {position}"


def test_it_is_a_reliability_whose_score_is_a_probability(classifier, logit):
    score = eqx.filter_jit(lambda model, obstacles, *step: model(obstacles, Transition(*step)).score)
    given = (box(0.1, 0.1, 0.02), rope(), jnp.zeros((1, 3)), rope(0.05), jnp.array(0.1))
    assert isinstance(classifier, Reliability)
    assert float(score(classifier, *given)) == pytest.approx(
        1 / (1 + np.exp(-float(logit(classifier, *given)))), abs=1e-3
    )


@pytest.mark.slow
def test_it_learns_that_a_box_in_the_way_makes_predictions_wrong(classifier):
    """32 transitions whose vectors say nothing of the label: only the voxels do."""
    count = 32
    places = jnp.concatenate([jnp.linspace(-0.5, 0.5, count // 2)] * 2)
    label = jnp.arange(count) < count // 2  # no box in the way
    aside = jnp.where(label, 0.15, 0.0)
    scenes = jax.vmap(lambda y, aside: box(0.1, 0.0, 0.02))(places, aside)
    centres = scenes.centre.at[:, 0, 1].set(places + aside)
    scenes = eqx.tree_at(lambda scenes: scenes.centre, scenes, centres)
    states = jax.vmap(lambda y: rope(0.0, y))(places)
    after = jax.tree.map(lambda leaf: leaf + jnp.array([0.05, 0.0, 0.0]), states)
    actions = jnp.broadcast_to(jnp.array([0.05, 0.0, 0.0]), (count, 1, 3))
    data = (scenes, Transition(states, actions, after, jnp.full(count, 0.1)))
    adam = optax.adam(3e-3)

    @eqx.filter_jit
    def train(model):
        weights, static = eqx.partition(model, eqx.is_inexact_array)

        def loss(weights):
            logits = jax.vmap(eqx.combine(weights, static).logit)(*data)
            return optax.sigmoid_binary_cross_entropy(logits, label.astype(float)).mean()

        def step(carry, _):
            weights, moments = carry
            value, gradient = jax.value_and_grad(loss)(weights)
            change, moments = adam.update(gradient, moments)
            return (eqx.apply_updates(weights, change), moments), value

        (weights, _), losses = jax.lax.scan(step, (weights, adam.init(weights)), None, length=40)
        return eqx.combine(weights, static), losses

    trained, losses = train(classifier)
    assert losses[-1] < 0.1 < losses[0]
    assert (np.asarray(jax.vmap(trained)(*data).accepted) == np.asarray(label)).all()
    assert trained.calibration.scale == 1  # left alone by training


def test_it_survives_a_file(classifier, logit, tmp_path):
    header = Header("voxel_classifier", "rope_dragging", asdict(classifier.config))
    save_model(tmp_path / "model.eqx", header, classifier)
    loaded, found = load_model(tmp_path, task="rope_dragging", kind="voxel_classifier")
    assert found.config == header.config
    assert loaded.config == classifier.config
    given = (box(0.1, 0.1, 0.02), rope(), jnp.zeros((1, 3)), rope(0.05), jnp.array(0.1))
    assert float(logit(loaded, *given)) == float(logit(classifier, *given))


def test_a_grid_that_the_convolutions_use_up_is_refused():
    with pytest.raises(ValueError, match=r"20 x 20 x 20 voxels, 3 convolutions leave 0 across and 0 up"):
        ViewConfig(2, "centroid", 20, 20, 0.04)
    with pytest.raises(ValueError, match="grippers is 3, expected 1 or 2"):
        view("quick", 3)
