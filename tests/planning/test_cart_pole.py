"""MPPI keeps two poles on top of each other upright, which they are not by themselves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from doojax.planning import Mppi, MppiSettings, rolled_out
from doojax.planning.costs import final, summed

CART, POLE, LENGTH, GRAVITY = 1.0, 0.1, 0.5, 9.81  # kg, kg at the end of each pole, m, m/s^2
STEP, FORCE = 0.02, 20.0  # s, N


def accelerations(place, speed, force):
    """Of the cart and of the poles' angles from upright, by Lagrange's equations."""
    first, second = place[1], place[2]
    between = jnp.cos(first - second)
    one, two = 2 * POLE * LENGTH, POLE * LENGTH
    mass = jnp.array(
        [
            [CART + 2 * POLE, one * jnp.cos(first), two * jnp.cos(second)],
            [one * jnp.cos(first), one * LENGTH, two * LENGTH * between],
            [two * jnp.cos(second), two * LENGTH * between, two * LENGTH],
        ]
    )
    spin = two * LENGTH * jnp.sin(first - second)
    rest = jnp.array(
        [
            force + one * jnp.sin(first) * speed[1] ** 2 + two * jnp.sin(second) * speed[2] ** 2,
            -spin * speed[2] ** 2 + one * GRAVITY * jnp.sin(first),
            spin * speed[1] ** 2 + two * GRAVITY * jnp.sin(second),
        ]
    )
    a, b, c = mass  # symmetric, so that these are its columns, too: Cramer's rule
    found = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)]) * rest[:, None]
    return found.sum(0) / (a * jnp.cross(b, c)).sum()


def move(state, control, step=STEP):
    """Runge and Kutta's step of cart and angles, then their speeds."""

    def slope(state):
        return jnp.concatenate([state[3:], accelerations(state[:3], state[3:], control[0])])

    a = slope(state)
    b = slope(state + step / 2 * a)
    c = slope(state + step / 2 * b)
    d = slope(state + step * c)
    return state + step / 6 * (a + 2 * b + 2 * c + d)


def energy(state):
    """Of cart and poles, from their places and speeds as points."""
    _, first, second, cart, spin, other = state
    one = jnp.stack([cart + LENGTH * jnp.cos(first) * spin, -LENGTH * jnp.sin(first) * spin])
    two = one + LENGTH * other * jnp.stack([jnp.cos(second), -jnp.sin(second)])
    height = LENGTH * jnp.cos(first) * 2 + LENGTH * jnp.cos(second)
    return (CART * cart**2 + POLE * (one**2).sum() + POLE * (two**2).sum()) / 2 + POLE * GRAVITY * height


BEGIN = jnp.array([0.0, 0.12, -0.08, 0.0, 0.0, 0.0])


def test_the_poles_are_poles():
    fall = jax.jit(
        lambda state: jax.lax.scan(lambda s, _: (move(s, jnp.zeros(1), 0.002),) * 2, state, length=1000)[1]
    )
    states = fall(BEGIN)
    assert float(jnp.abs(states[:, 1]).max()) > 2  # they fall, and swing through
    energies = np.asarray(jax.vmap(energy)(states))
    assert np.abs(energies - float(energy(BEGIN))).max() < 2e-3


def test_two_poles_stay_upright():
    terms = {
        "poles": summed(
            lambda s, u: 10 * (2 - jnp.cos(s[1]) - jnp.cos(s[2])) + 0.1 * (s[4] ** 2 + s[5] ** 2)
        ),
        "cart": summed(lambda s, u: 0.1 * s[0] ** 2 + 0.1 * s[3] ** 2),
        "end": final(lambda s: 100 * (2 - jnp.cos(s[1]) - jnp.cos(s[2])) + s[4] ** 2 + s[5] ** 2),
    }
    settings = MppiSettings(samples=256, horizon=20, temperature=0.1, noise=8.0)
    controller = Mppi(rolled_out(move), terms, [-FORCE], [FORCE], settings)

    @eqx.filter_jit
    def controlled(key):
        def live(carry, time):
            state, nominal = carry
            nominal, _ = controller(nominal, state, jax.random.fold_in(key, time))
            state = move(state, nominal.controls[0])
            return (state, nominal.advanced()), state

        return jax.lax.scan(live, (BEGIN, controller.start()), jnp.arange(150))[1]

    states = controlled(jax.random.key(0))
    assert float(jnp.abs(states[:, 1:3]).max()) < 0.6
    assert float(jnp.abs(states[-50:, 1:3]).max()) < 0.2
    still = jax.lax.scan(lambda s, _: (move(s, jnp.zeros(1)),) * 2, BEGIN, length=150)[1]
    assert float(jnp.abs(still[:, 1:3]).max()) > 1  # without control they fall
