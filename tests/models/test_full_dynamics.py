"""Dynamics that see obstacles: windows of trajectories, and whether a wall is learned to stop a point."""

from dataclasses import asdict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.learning.checkpoints import Header, load_model, save_model
from doojax.learning.data import Trajectories
from doojax.learning.fit import FitConfig, fit
from doojax.learning.full_dynamics import windows
from doojax.learning.losses import DynamicsProblem, errors
from doojax.learning.runs import RunDirectory
from doojax.models import Dynamics
from doojax.models.full_dynamics import FullDynamics, FullDynamicsConfig
from doojax.models.rolling import roll_out
from doojax.types import RopeState
from tests.calls import called

from .voxel_examples import FLAT, box

CONFIG = FullDynamicsConfig(1, FLAT, width=32, scene_width=16)


def pushed(count, steps, seed, first_row=0):
    """A point pushed along x by 0 to 5 cm a step; in half of the scenes a wall stops it at x = 0.06 m."""
    random = np.random.default_rng(seed)
    walled = np.arange(count) % 2 == 0
    actions = np.zeros((count, steps, 1, 3), np.float32)
    actions[..., 0] = random.uniform(0, 0.05, (count, steps, 1))
    places = np.zeros((count, steps + 1, 1, 3), np.float32)
    places[:, 0, 0, 0] = random.uniform(-0.1, 0.06, count)
    places[..., 2] = 0.02
    for step in range(steps):
        after = places[:, step, 0, 0] + actions[:, step, 0, 0]
        places[:, step + 1, 0, 0] = np.where(walled, np.minimum(after, 0.06), after)
    scene = box(0.11, 0.0, 0.02, half=(0.05, 0.5, 0.1))
    scenes = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], count, axis=0), scene)
    return Trajectories(
        states=RopeState(points=jnp.asarray(places), grippers=jnp.asarray(places)),
        actions=jnp.asarray(actions),
        obstacles=eqx.tree_at(lambda scenes: scenes.active, scenes, jnp.asarray(walled)[:, None]),
        rows=jnp.arange(count) + first_row,
    )


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    parts = windows([pushed(192, 3, 0)], 3), windows([pushed(64, 3, 1)], 3)
    problem = DynamicsProblem(*parts, CONFIG, True, FullDynamics, at_once=32)
    run = RunDirectory.open(tmp_path_factory.mktemp("run") / "fit", {})
    config = FitConfig(epochs=40, batch_size=32, learning_rate=3e-3)
    models = fit(problem, config, seed=0, run=run)
    return jax.tree.map(lambda leaf: leaf[0] if eqx.is_array(leaf) else leaf, models), run


@pytest.fixture(scope="module")
def fresh():
    """A network that was scaled to data and not trained."""
    model = FullDynamics(CONFIG, key=jax.random.key(0))
    return called(model.scaled_to, *pushed(16, 2, 3).transitions())


@pytest.fixture(scope="module")
def errors_of():
    return eqx.filter_jit(lambda model, window: errors(model, window))


@pytest.fixture(scope="module")
def step():
    return eqx.filter_jit(lambda model, *arguments: model(*arguments))


@pytest.mark.slow  # all else is true of networks that were not trained
def test_a_wall_stops_the_point_and_nothing_else_does(learned, step):
    model, run = learned
    assert run.metrics[-1]["validation_error_m"][0] < 0.006  # m; a guess blind to the wall errs by 0.02
    start = RopeState(points=jnp.array([[0.05, 0.0, 0.02]]), grippers=jnp.array([[0.05, 0.0, 0.02]]))
    action = jnp.array([[0.04, 0.0, 0.0]])
    wall = box(0.11, 0.0, 0.02, half=(0.05, 0.5, 0.1))
    parked = eqx.tree_at(lambda scene: scene.active, wall, jnp.array([False]))
    stopped, uncertainty = step(model, wall, start, action)
    free, _ = step(model, parked, start, action)
    assert stopped.points[0, 0] == pytest.approx(0.06, abs=0.01)
    assert free.points[0, 0] == pytest.approx(0.09, abs=0.01)
    assert stopped.grippers[0, 0] == pytest.approx(0.06, abs=0.01)
    assert uncertainty == 0


def test_the_same_push_elsewhere_does_the_same(fresh, step):
    model = fresh
    shift = jnp.array([0.5, -0.25, 0.125])
    start = RopeState(points=jnp.array([[0.03, 0.0, 0.02]]), grippers=jnp.array([[0.03, 0.0, 0.02]]))
    moved = jax.tree.map(lambda leaf: leaf + shift, start)
    wall = box(0.115, 0.0, 0.02, half=(0.05, 0.5, 0.1))
    there = eqx.tree_at(lambda scene: scene.centre, wall, wall.centre + shift)
    action = jnp.array([[0.04, 0.0, 0.0]])
    here, _ = step(model, wall, start, action)
    elsewhere, _ = step(model, there, moved, action)
    np.testing.assert_allclose(elsewhere.points - shift, here.points, atol=1e-4)


def test_a_roll_out_repeats_single_steps_and_its_errors_are_theirs(fresh, step, errors_of):
    model = fresh
    window = jax.tree.map(lambda leaf: leaf[0], pushed(2, 3, 5))
    first = jax.tree.map(lambda leaf: leaf[0], window.states)
    states, state = [first], first
    for action in window.actions:
        state, _ = step(model, window.obstacles, state, action)
        states.append(state)
    rolled, _ = called(roll_out, model, window.obstacles, first, window.actions)
    np.testing.assert_allclose(rolled.points, jnp.stack([s.points for s in states]), atol=1e-5)
    loss, error = errors_of(model, window)
    gap = np.asarray(rolled.points - window.states.points)[1:, 0]
    np.testing.assert_allclose(error, np.linalg.norm(gap, axis=-1), atol=1e-6)
    both = np.concatenate([gap, np.asarray(rolled.grippers - window.states.grippers)[1:, 0]], axis=1)
    assert float(loss) == pytest.approx((both**2).mean(), rel=1e-4)


def test_a_fresh_network_scaled_to_data_starts_near_standing_still(fresh, errors_of):
    assert isinstance(fresh, Dynamics)
    assert fresh.input_scale.min() == pytest.approx(0.03)
    window = jax.tree.map(lambda leaf: leaf[0], pushed(2, 3, 5))
    _, error = errors_of(fresh, window)
    assert error.max() < 0.2


def test_windows_hold_every_action_once_or_twice_and_what_led_to_it():
    short, long = pushed(4, 3, 0), pushed(3, 8, 1, first_row=100)
    cut = windows([short, long], 3)
    short, long, cut = jax.tree.map(np.asarray, (short, long, cut))
    assert len(cut) == 4 + 3 * 3
    np.testing.assert_array_equal(cut.rows, [0, 1, 2, 3, *np.repeat([100, 101, 102], 3)])
    np.testing.assert_array_equal(cut.actions[:4], short.actions)
    for row in range(3):
        for piece, start in enumerate((0, 3, 5)):
            window = 4 + 3 * row + piece
            np.testing.assert_array_equal(cut.actions[window], long.actions[row, start : start + 3])
            np.testing.assert_array_equal(
                cut.states.points[window], long.states.points[row, start : start + 4]
            )
            assert cut.obstacles.active[window] == long.obstacles.active[row]


def test_windows_say_what_does_not_fit():
    with pytest.raises(ValueError, match="steps is 4, expected 1 to 3"):
        windows([pushed(2, 3, 0), pushed(2, 9, 0)], 4)
    other = eqx.tree_at(lambda data: data.states.points, pushed(2, 3, 0), jnp.zeros((2, 4, 5, 3)))
    with pytest.raises(ValueError, match=r"\[\(1, 1, 1\), \(5, 1, 1\)\].*same task"):
        windows([pushed(2, 3, 0), other], 3)
    with pytest.raises(ValueError, match="same task"):
        windows([], 3)


def test_it_survives_a_file(fresh, errors_of, tmp_path):
    model = fresh
    header = Header("full_dynamics", "rope_dragging", asdict(model.config))
    save_model(tmp_path / "model.eqx", header, model)
    loaded, _ = load_model(tmp_path, kind="full_dynamics")
    assert loaded.config == model.config
    window = jax.tree.map(lambda leaf: leaf[0], pushed(2, 3, 5))
    assert float(errors_of(loaded, window)[0]) == float(errors_of(model, window)[0])
    with pytest.raises(ValueError, match="expected one of kind 'voxel_classifier'"):
        load_model(tmp_path, kind="voxel_classifier")
