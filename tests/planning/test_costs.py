"""Terms beside numbers worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.planning import costs

HANDS = jnp.array([[3.0, 4.0, 0.0], [0.0, 0.0, 7.0]])
ORIGIN = jnp.zeros(3)


@pytest.mark.parametrize(
    ("cost", "expected"),
    [
        (lambda: costs.reaching(HANDS[0], ORIGIN), 5),
        (lambda: costs.hands_reaching(HANDS, jnp.array([True, False]), ORIGIN), 5),
        (lambda: costs.hands_reaching(HANDS, jnp.array([True, True]), ORIGIN), 12),
        (lambda: costs.contacts(jnp.array(0)), 0),
        (lambda: costs.contacts(jnp.array(1)), 6**-0.5),
        (lambda: costs.contacts(jnp.array(6)), 1),
        (lambda: costs.contacts(jnp.array(60)), 1),
        (lambda: costs.closeness(jnp.array(0.03), 0.02), 0),
        (lambda: costs.closeness(jnp.array(0.01), 0.02), 0.25),
        (lambda: costs.closeness(jnp.array(-0.02), 0.02), 4),
        (lambda: costs.finger(jnp.array([0.1, 0.4]), jnp.array([0.06, 0.45])), 0.09),
        (lambda: costs.grasping(HANDS, HANDS + 1, jnp.array([False, True])), 3**0.5),
        (lambda: costs.unstable(jnp.array(4)), 1),
        (lambda: costs.unstable(jnp.array(0)), 0),
        (lambda: costs.torn(jnp.array([0.1, 0.2])), 0.05),
        # d^2 - 0.1 of the hand that holds nothing: 0.06 to the nearer of two points, 0.3 to the farther
        (
            lambda: costs.rope_near(
                jnp.array([[0.4, 0, 0], [9.0, 0, 0]]),
                jnp.array([False, True]),
                jnp.array([[0.0, 0, 0], [0.4, 0.4**0.5, 0]]),
            ),
            0.06,
        ),
        (lambda: costs.smoothness(None, jnp.array([[0.0, 0.0], [3.0, 4.0], [3.0, 5.0]])), 6),
    ],
)
def test_a_cost_is_what_it_says(cost, expected):
    assert float(jax.jit(cost)()) == pytest.approx(expected, abs=1e-6)


def test_terms_sum_weigh_and_look_at_the_end():
    states, controls = {"x": jnp.array([1.0, 2.0, 3.0])}, jnp.array([[1.0], [0.0], [2.0]])
    both = costs.summed(lambda state, control: state["x"] * control[0])
    assert float(both(states, controls)) == 7
    assert float(costs.weighted(0.5, both)(states, controls)) == 3.5
    assert float(costs.final(lambda state: state["x"])(states, controls)) == 3


def test_weights_belong_to_costs():
    named = set(costs.THESIS_WEIGHTS) - {"rope_touched"}  # `contacts` again
    assert all(callable(getattr(costs, name)) for name in named)
    assert np.isclose(costs.THESIS_WEIGHTS["rope_touched"], 0.5 * costs.THESIS_WEIGHTS["contacts"])
