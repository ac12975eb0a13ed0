"""Which states are stuck, judged in a batch as alone; what recovery networks learn from."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.learning.data import Trajectories
from doojax.learning.recovery import (
    RecoveryExamples,
    RecoveryProblem,
    acceptance,
    acceptances,
    label_recovery,
)
from doojax.models.classifier import ClassifierConfig, DistanceClassifier
from doojax.models.protocols import above
from doojax.models.recovery import RecoveryNetwork, carried_along
from doojax.tasks import make_task
from doojax.types import Obstacles, RopeState
from tests.calls import called

SIZE = {"grippers": 1, "origin": "gripper", "width": 8}


class Carried(eqx.Module):
    """Dynamics: the rope goes along with the gripper."""

    def __call__(self, obstacles, state, action):
        return carried_along(state, action), jnp.zeros(())


class Moved(eqx.Module):
    """Accepts what moves to the side of its scene's obstacle, so that mixing up scenes shows."""

    threshold: float = 0.0

    def __call__(self, obstacles, transition):
        to_its_side = transition.action[0, 0] * obstacles.centre[0, 0]
        return above(to_its_side - transition.state.points[0, 1], self.threshold)


def scenes(*sides):
    count = len(sides)
    centre = jnp.zeros((count, 1, 3)).at[:, 0, 0].set(jnp.array(sides))
    return Obstacles(
        kind=jnp.zeros((count, 1), jnp.int32),
        centre=centre,
        quaternion=jnp.tile(jnp.array([1.0, 0, 0, 0]), (count, 1, 1)),
        half_size=jnp.full((count, 1, 3), 0.01),
        active=jnp.ones((count, 1), bool),
    )


def ropes(lateral):
    """Ropes of five points along x at y = lateral[k][t] (m)."""
    y = jnp.asarray(lateral)
    points = jnp.zeros((*y.shape, 5, 3)).at[..., 0].set(0.05 * jnp.arange(5.0)).at[..., 2].set(0.05)
    points = points.at[..., 1].set(y[..., None])
    return RopeState(points, points[..., -1:, :])


@pytest.fixture(scope="session")
def data():
    # how much is accepted falls as y grows: at 1 m nothing is, at -1 m everything
    states = ropes([[1.0, -1.0, 1.0], [0.0, 1.0, 1.0], [-1.0, -1.0, -1.0]])
    return Trajectories(states, jnp.full((3, 2, 1, 3), 0.01), scenes(1.0, -1.0, 0.5), jnp.arange(3))


def test_every_state_is_judged_in_its_own_scene_with_its_own_actions(data):
    task, key = make_task("toy"), jax.random.key(4)

    @jax.jit
    def one_of(scene, state, key):
        return acceptance(task, Carried(), Moved(), scene, state, key=key)

    together = acceptances(task, Carried(), Moved(), data.obstacles, data.states, key=key)
    for row in range(3):
        for time in range(3):
            scene = jax.tree.map(lambda leaf, r=row: leaf[r], data.obstacles)
            state = jax.tree.map(lambda leaf, r=row, t=time: leaf[r, t], data.states)
            own = jax.random.fold_in(key, 3 * row + time)
            alone = one_of(scene, state, own)
            assert float(together[row, time]) == float(alone)
    assert 0 < float(together[1, 0]) < 1


def test_examples_are_actions_taken_where_nothing_is_accepted(data):
    found = label_recovery(make_task("toy"), Carried(), Moved(), data, key=jax.random.key(4))
    assert np.asarray(found.trajectory).tolist() == [0, 1]
    assert np.asarray(found.time).tolist() == [0, 1]
    assert np.asarray(found.acceptance).tolist() == [1.0, 0.0]  # freed at once; as stuck as before
    np.testing.assert_allclose(found.obstacles.centre[:, 0, 0], [1.0, -1.0])


def test_a_perfect_recovery_weighs_as_much_as_any_other(data):
    examples = RecoveryExamples(
        state=jax.tree.map(lambda leaf: leaf[:2, 0], data.states),
        action=data.actions[:2, 0],
        obstacles=jax.tree.map(lambda leaf: leaf[:2], data.obstacles),
        acceptance=jnp.array([1.0, 0.0]),
        trajectory=jnp.arange(2),
        time=jnp.zeros(2, jnp.int32),
    )
    encoder = DistanceClassifier(ClassifierConfig(**SIZE), key=jax.random.key(1))
    problem = RecoveryProblem(examples, examples, encoder, ClassifierConfig(**SIZE))
    model = problem.init(None, key=jax.random.key(2))
    assert (model.network.embed.weight == encoder.embed.weight).all()
    assert (model.network.head.layers[0].weight != encoder.head.layers[0].weight).any()
    logits = [
        float(
            called(
                model.logit,
                *jax.tree.map(
                    lambda leaf, i=i: leaf[i], (examples.obstacles, examples.state, examples.action)
                ),
            )
        )
        for i in range(2)
    ]
    expected = (np.log1p(np.exp(-logits[0])) + np.log1p(np.exp(logits[1]))) / 2
    assert float(called(problem.loss, model, jnp.arange(2), None)) == pytest.approx(expected, rel=1e-5)


def test_a_recovery_network_gives_a_probability_that_turns_with_the_scene():
    network = RecoveryNetwork(ClassifierConfig(**SIZE), key=jax.random.key(3))
    state = jax.tree.map(lambda leaf: leaf[0, 0], ropes([[0.0]]))
    scene = jax.tree.map(lambda leaf: leaf[0], scenes(0.3))
    action = jnp.array([[0.02, 0.05, 0.0]])
    turn = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned_state = jax.tree.map(lambda leaf: leaf @ turn.T, state)
    turned_scene = eqx.tree_at(lambda s: s.centre, scene, scene.centre @ turn.T)
    probability = float(called(network, scene, state, action))
    assert 0 < probability < 1
    assert float(called(network, turned_scene, turned_state, action @ turn.T)) == pytest.approx(
        probability, abs=1e-5
    )


def test_points_between_two_grippers_are_carried_in_proportion():
    state = RopeState(jnp.zeros((3, 3)), jnp.zeros((2, 3)))
    after = carried_along(state, jnp.array([[1.0, 0, 0], [0, 1.0, 0]]))
    np.testing.assert_allclose(after.points, [[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0]])
    np.testing.assert_allclose(after.grippers, [[1, 0, 0], [0, 1, 0]])
