"""The cable and its fixtures: where the released code has them, and hung as a chain hangs."""

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.keys import generator
from doojax.tasks.arms import BASE
from doojax.tasks.threading import (
    FASTENED,
    FIXTURES,
    HELD,
    LENGTH,
    LINKS,
    SPREAD,
    hanging,
    opening,
    threading,
)
from doojax.topology.field import magnetic_field
from doojax.topology.linking import linking_number

TASK = threading()


@pytest.fixture(scope="module")
def drawn():
    return [TASK.draw(TASK, generator(0, "test", "threading", str(i))) for i in range(20)]


def test_an_opening_has_the_corners_and_the_field_of_the_released_code():
    found = opening(np.array(FIXTURES["loop1"]))
    expected = [
        (0.2029, 0.5071, 0.42),
        (0.2029, 0.5071, 0.26),
        (0.2940, 0.6739, 0.26),
        (0.2940, 0.6739, 0.42),
    ]
    for corner in expected:
        assert np.abs(found - corner).max(1).min() < 1e-4
    field = np.asarray(magnetic_field(jnp.asarray(found), jnp.asarray(found[:-1].mean(0))))
    np.testing.assert_allclose(field / np.linalg.norm(field), [-0.878, 0.480, 0], atol=1e-3)


def test_a_cable_that_goes_from_its_fastening_to_the_goal_goes_along_the_fields(drawn):
    for one in drawn[:3]:
        middles = {name: loop[:-1].mean(0) for name, loop in TASK.loops(one.centres).items()}
        way = [one.centres["attach"], *middles.values(), one.goal]
        closed = np.array([*way, one.goal - [0, 3, 0], way[0] - [0, 3, 0], way[0]])
        for loop in TASK.loops(one.centres).values():
            assert linking_number(closed, loop) == 1


def test_what_is_drawn_is_within_the_limits(drawn):
    for one in drawn:
        for name, place in FIXTURES.items():
            off = np.abs(one.centres[name] - np.array(BASE) - place)
            assert off[0] <= SPREAD[0] and off[1] == 0 and off[2] <= SPREAD[1]
        assert np.isnan(one.start[0]) and HELD[0] <= one.start[1] <= HELD[1]
        np.testing.assert_allclose(one.rope[0] - np.array(BASE), FASTENED, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(np.diff(one.rope, axis=0), axis=1), LENGTH / LINKS)
    assert len({float(one.goal @ one.centres["loop1"]) for one in drawn}) == len(drawn)


def test_the_cable_hangs_between_fastening_and_hand_and_in_equilibrium():
    begin, hand = np.array([0.75, 0.62, 1.345]), np.array([0.4, 0.4, 0.7])
    for place in HELD:
        rope = hanging(begin, hand, place)
        link = int(place * LINKS)
        held = rope[link] + (place * LINKS - link) * (rope[link + 1] - rope[link])
        np.testing.assert_allclose(held, hand, atol=1e-4)
        steps = np.diff(rope, axis=0)
        slopes = steps[:, 2] / np.linalg.norm(steps[:, :2], axis=1)
        # the level part of the tension is the same everywhere, the other grows by each link's weight
        np.testing.assert_allclose(np.diff(slopes), np.diff(slopes)[0], rtol=1e-6)
        assert rope[:, 2].min() < hand[2] - 0.3  # slack
