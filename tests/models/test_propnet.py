"""PropNet: who knows of whom, and that it does not matter which is called which."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.keys import generator, stream
from doojax.models.propnet import PropNet, PropNetConfig, pushed_along
from doojax.types import PushingState
from tests.calls import called

BODIES, PERIOD = 5, 0.25
CONFIG = PropNetConfig(BODIES, PERIOD, particle=8, relation=8, effect=8, passes=2)


@pytest.fixture(scope="module")
def model():
    return PropNet(CONFIG, key=stream(0, "test", "propnet"))


def chain():
    """The hand, and bodies in a row, 4.5 cm from one to the next; the last far away."""
    x = np.append(0.045 * np.arange(1, BODIES), 0.6)
    places = np.stack([np.append(x, 0.0), np.zeros(BODIES + 1)], -1)
    return jnp.asarray(places, jnp.float32), jnp.zeros((BODIES + 1, 2))


def test_a_push_is_felt_as_far_as_effects_are_passed(model):
    """The first pass goes to who is joined to the hand, each further one a body on."""
    places, before = chain()
    moves = called(model.moves, places, before)
    pushed = called(model.moves, places, before.at[-1, 0].set(0.01))
    felt = np.abs(np.asarray(pushed - moves)).max(1) > 1e-9
    assert felt.tolist() == [True, True, False, False, False]


def test_what_is_out_of_reach_does_not_matter(model):
    places, before = chain()
    away = called(model.moves, places.at[-2].set(jnp.array([0.9, 0.3])), before)
    np.testing.assert_allclose(away[:-1], called(model.moves, places, before)[:-1], atol=1e-7)


def test_names_do_not_matter(model):
    draw = generator(0, "places")
    places = jnp.asarray(draw.uniform(-0.06, 0.06, (BODIES + 1, 2)), jnp.float32)
    before = jnp.asarray(draw.uniform(-0.01, 0.01, (BODIES + 1, 2)), jnp.float32)
    order = np.append(draw.permutation(BODIES), BODIES)
    moves = called(model.moves, places, before)
    np.testing.assert_allclose(
        called(model.moves, places[order], before[order]), moves[order[:-1]], atol=1e-6
    )


def test_as_many_joints_as_are_within_reach_give_the_same(model):
    places, before = chain()
    within = 2 * (BODIES - 1)  # both ways, between neighbours in the row and the hand
    few = eqx.tree_at(
        lambda m: m.predictor,
        PropNet(PropNetConfig(**(vars(CONFIG) | {"joints": within})), key=stream(0, "test", "propnet")),
        model.predictor,
    )
    np.testing.assert_allclose(
        called(few.moves, places, before), called(model.moves, places, before), atol=1e-6
    )


def test_a_step_of_dynamics_is_a_period_of_a_roll_out(model):
    places, before = chain()
    hand_move = jnp.array([0.004, -0.002])
    state = PushingState(
        positions=jnp.concatenate([places[:-1], jnp.full((BODIES, 1), 0.02)], axis=1),
        velocities=jnp.zeros((BODIES, 3)),
        hand=jnp.append(places[-1], 0.02),
    )
    after, doubt = called(model, None, state, jnp.append(hand_move, 0.0)[None])
    ends, moves = called(pushed_along, model, places, before, places[-1:], hand_move[None])
    np.testing.assert_allclose(after.positions[:, :2], ends[0], atol=1e-7)
    np.testing.assert_allclose(after.velocities[:, :2] * PERIOD, moves[0], atol=1e-7)
    np.testing.assert_allclose(after.hand, [0.004, -0.002, 0.02], atol=1e-7)
    assert float(doubt) == 0.0


def test_derivatives_are_finite_where_two_bodies_coincide(model):
    places, before = chain()
    slope = jax.jit(jax.grad(lambda at: model.moves(at, before).sum()))(places.at[1].set(places[0]))
    assert bool(jnp.isfinite(slope).all())
