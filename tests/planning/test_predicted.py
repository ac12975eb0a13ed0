"""MPPI over learned dynamics keeps to where a reliability accepts what they predict."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.models.protocols import above
from doojax.planning import Mppi, MppiSettings, PredictedRollouts, Unreliable
from doojax.planning.costs import summed


class Moves(eqx.Module):
    """A point that goes where it is sent; it is unsure of steps that are long."""

    gain: jax.Array

    def __call__(self, obstacles, state, action):
        return state + self.gain * action[0], jnp.abs(action).sum()


class Low(eqx.Module):
    """Trusts whatever ends below a height."""

    height: jax.Array

    def __call__(self, obstacles, transition):
        return above(self.height - transition.next_state[1], 0.0)


DYNAMICS = Moves(jnp.array(0.5))
ROLLOUTS = PredictedRollouts(DYNAMICS, None, (1, 2))
UNRELIABLE = Unreliable(Low(jnp.array(0.3)), None, weight=10.0)
CONTROLS = jax.random.uniform(jax.random.key(0), (5, 4, 2), minval=-1.0)


def test_transitions_are_those_of_the_dynamics_and_priced_where_refused():
    found = ROLLOUTS(jnp.array([0.0, 0.1]), CONTROLS, jnp.zeros(5))
    places = np.array([0.0, 0.1]) + 0.5 * np.cumsum(np.asarray(CONTROLS), axis=1)
    np.testing.assert_allclose(found.next_state, places, atol=1e-6)
    np.testing.assert_allclose(found.state[:, 1:], places[:, :-1], atol=1e-6)
    np.testing.assert_array_equal(found.action, np.asarray(CONTROLS)[:, :, None])
    np.testing.assert_allclose(found.uncertainty, np.abs(CONTROLS).sum(-1), rtol=1e-6)
    prices = jax.vmap(UNRELIABLE)(found, CONTROLS)
    np.testing.assert_allclose(prices, 10.0 * (places[..., 1] >= 0.3).sum(-1))
    doubt = Unreliable(UNRELIABLE.reliability, None, price=lambda judged: -judged.score)
    np.testing.assert_allclose(jax.vmap(doubt)(found, CONTROLS), (places[..., 1] - 0.3).sum(-1), atol=1e-5)


@pytest.mark.parametrize("trusts", [True, False])
def test_a_goal_where_nothing_can_be_trusted_is_approached_as_near_as_it_can(trusts):
    goal = jnp.array([1.0, 1.0])
    terms = {"goal": summed(lambda transition, _: jnp.sum((transition.next_state - goal) ** 2))}
    if not trusts:
        terms["unreliable"] = UNRELIABLE
    settings = MppiSettings(samples=256, horizon=3, temperature=0.1, noise=0.3)
    controller = Mppi(ROLLOUTS, terms, [-1.0, -1.0], [1.0, 1.0], settings)

    @eqx.filter_jit
    def improved(controller, key):
        def improve(number, nominal):
            return controller(nominal, jnp.zeros(2), jax.random.fold_in(key, number))[0]

        return jax.lax.fori_loop(0, 20, improve, controller.start()).controls

    places = 0.5 * np.cumsum(np.asarray(improved(controller, jax.random.key(1))), axis=0)
    assert places[-1, 0] > 0.8
    assert (places[-1, 1] > 0.8) if trusts else (0.1 < places[:, 1].max() < 0.3)
