"""Goals in state space, samples and nearest neighbours, against NumPy and scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from doojax.models.recovery import carried_along
from doojax.planning import all_of, metric
from doojax.planning.metric import rope_sample
from doojax.tasks import gripper_goal, make_task, point_goal
from doojax.tasks.dual_gripper import REACH, _place_rope
from doojax.tasks.toy import HEIGHT, PITCH
from doojax.types import RopeState

from .problems import TOY, problem

DUAL = make_task("dual_gripper")
CAPACITY = 2500  # more than two chunks, and no multiple of one


def ropes(count: int, points: int, grippers: int, seed: int = 0) -> RopeState:
    rng = np.random.default_rng(seed)
    shapes = ((count, points, 3), (count, grippers, 3))
    return RopeState(*(jnp.asarray(rng.uniform(-1, 1, shape), dtype=jnp.float32) for shape in shapes))


@pytest.mark.parametrize("capacity, grippers", [(CAPACITY, 1), (100, 2)])
@settings(max_examples=12, deadline=None)
@given(part=st.floats(0, 1), share=st.floats(0, 1), seed=st.integers(0, 1000))
def test_the_nearest_is_the_one_that_a_kd_tree_finds(capacity, grippers, part, share, seed):
    rng = np.random.default_rng(seed)
    filled = 1 + int(part * (capacity - 1))
    states = ropes(capacity, 5, grippers, seed)
    eligible = rng.uniform(size=capacity) < share
    eligible[0] = True
    # what was rejected may have been rejected because it is not finite
    broken = jnp.asarray(~eligible & (rng.uniform(size=capacity) < 0.1))
    states = jax.tree.map(lambda leaf: jnp.where(broken[:, None, None], jnp.nan, leaf), states)
    samples = rng.uniform(-1, 1, (16, 5 + grippers, 3)).astype(np.float32)
    found = np.asarray(nearest(jnp.asarray(samples), states, jnp.asarray(eligible), jnp.array(filled)))

    choice = np.flatnonzero(eligible[:filled])
    everything = np.asarray(states.bodies()).reshape(capacity, -1)
    distance, _ = cKDTree(everything[choice]).query(samples.reshape(16, -1))
    assert np.isin(found, choice).all()
    found_distance = np.linalg.norm(everything[found] - samples.reshape(16, -1), axis=-1)
    assert found_distance == pytest.approx(distance, rel=1e-4)


nearest = jax.jit(metric.nearest)


def test_of_equals_the_first_is_nearest():
    state = ropes(1, 5, 1)
    states = jax.tree.map(lambda leaf: jnp.repeat(leaf, CAPACITY, axis=0), state)
    eligible = jnp.arange(CAPACITY) >= 1500
    found = nearest(jnp.zeros((16, 6, 3)), states, eligible, jnp.array(CAPACITY))
    assert (np.asarray(found) == 1500).all()


def test_a_goal_is_as_far_as_its_farthest_target():
    state = jax.tree.map(lambda leaf: leaf[0], ropes(1, 25, 2))
    points, grippers = np.asarray(state.points), np.asarray(state.grippers)
    place, left, right = (np.array(p) for p in ([0.9, 0.0, 0.8], [0.8, 0.2, 1.0], [0.8, -0.2, 1.0]))
    tail = np.linalg.norm(points - place, axis=-1)
    hands = max(np.linalg.norm(grippers[0] - left), np.linalg.norm(grippers[1] - right))
    at_point = point_goal(DUAL, jnp.asarray(place))
    at_any = point_goal(DUAL, jnp.asarray(place), points=range(7, 18))
    at_hands = gripper_goal(DUAL, jnp.asarray([left, right]))
    assert float(at_point.distance(state)) == pytest.approx(tail[12], rel=1e-6)
    assert float(at_any.distance(state)) == pytest.approx(tail[7:18].min(), rel=1e-6)
    assert float(at_hands.distance(state)) == pytest.approx(hands, rel=1e-6)
    both = all_of(at_any, at_hands)
    assert float(both.distance(state)) == pytest.approx(max(tail[7:18].min(), hands), rel=1e-6)
    assert float(both.tolerance) == pytest.approx(DUAL.goal_threshold)


def test_goals_that_name_what_is_not_there_are_refused():
    place = jnp.array([0.0, 0.0, HEIGHT])
    with pytest.raises(ValueError, match=r"points are \[5\], expected some of the rope's points 0 to 4"):
        point_goal(TOY, place, points=[5])
    with pytest.raises(ValueError, match="expected some of the rope's points"):
        point_goal(TOY, place, points=[])
    with pytest.raises(ValueError, match="2 positions for 1 grippers"):
        gripper_goal(TOY, jnp.zeros((2, 3)))
    with pytest.raises(ValueError, match="at least one goal"):
        all_of()


@pytest.mark.parametrize("towards_goal", [False, True])
def test_a_sample_is_the_rope_itself_turned_and_moved(towards_goal):
    shape = jax.tree.map(lambda leaf: leaf[0], ropes(1, 5, 1)).bodies()
    target = jnp.array([0.2, -0.1, HEIGHT])
    goal = point_goal(TOY, target, points=[1, 3])
    samples = jax.vmap(
        lambda key: metric.rope_sample(key, TOY.workspace, shape, goal, jnp.array(towards_goal))
    )(jax.random.split(jax.random.key(0), 400))
    samples, shape = np.asarray(samples), np.asarray(shape)

    def gaps(bodies):
        return np.linalg.norm(bodies[..., :, None, :] - bodies[..., None, :, :], axis=-1)

    assert gaps(samples) == pytest.approx(np.broadcast_to(gaps(shape), (400, 6, 6)), abs=1e-5)
    assert np.diff(samples[..., 2]) == pytest.approx(
        np.broadcast_to(np.diff(shape[:, 2]), (400, 5)), abs=1e-6
    )
    if towards_goal:
        at = np.linalg.norm(samples - np.asarray(target), axis=-1) < 1e-6
        assert (at.sum(-1) == 1).all() and abs(at[:, 1].mean() - 0.5) < 0.1
        assert (at[:, 1] | at[:, 3]).all()
    else:
        middle = samples.mean(1)
        assert middle[:, :2].mean(0) == pytest.approx([0, 0], abs=4 * 0.29 / 20)
        assert middle[:, :2].std(0) == pytest.approx([0.289, 0.289], abs=0.04)  # of a uniform number


def test_towards_a_goal_of_several_targets_every_body_is_put_on_its_own():
    shape = jax.tree.map(lambda leaf: leaf[0], ropes(1, 25, 2)).bodies()
    place, hands = jnp.array([0.9, 0.0, 0.8]), jnp.array([[0.8, 0.2, 1.0], [0.8, -0.2, 1.0]])
    goal = all_of(point_goal(DUAL, place), gripper_goal(DUAL, hands))
    sample = metric.rope_sample(jax.random.key(1), DUAL.workspace, shape, goal, jnp.array(True))
    assert np.asarray(sample[12]) == pytest.approx(np.asarray(place), abs=1e-6)
    assert np.asarray(sample[25:]) == pytest.approx(np.asarray(hands), abs=1e-6)


def test_the_thesiss_sample_crumples_the_rope_into_a_point():
    shape = PITCH * jnp.ones((6, 3))
    goal = point_goal(TOY, jnp.array([0.2, -0.1, HEIGHT]))
    free = metric.point_sample(jax.random.key(0), TOY.workspace, shape, goal, jnp.array(False))
    there = metric.point_sample(jax.random.key(0), TOY.workspace, shape, goal, jnp.array(True))
    assert (np.asarray(free) == np.asarray(free[0])).all()
    assert (np.asarray(there) == np.asarray(goal.targets[0])).all()


def test_lengths_are_not_multiplied_in_a_gpus_short_precision():
    """By default a GPU rounds factors of float32 products to three digits, millimetres here."""
    state = RopeState(jnp.zeros((4, 5, 3)), jnp.zeros((4, 1, 3)))
    goal, key = problem().goal, jax.random.key(0)
    shape = jnp.zeros((6, 3))
    traced = [
        jax.make_jaxpr(lambda *a: metric.nearest(*a, jnp.ones(4, bool), jnp.array(4)))(
            jnp.zeros((2, 6, 3)), state
        ),
        jax.make_jaxpr(lambda k: rope_sample(k, TOY.workspace, shape, goal, jnp.array(True)))(key),
        jax.make_jaxpr(carried_along)(jax.tree.map(lambda leaf: leaf[0], state), jnp.zeros((1, 3))),
        jax.make_jaxpr(lambda k: _place_rope(REACH["constrained"], k, jnp.zeros((5, 3))))(key),
    ]
    for text in map(str, traced):
        assert (
            text.count("dot_general[") == text.count("precision=(Precision.HIGHEST, Precision.HIGHEST)") > 0
        )
