"""Pieces of trajectories: each step once, or from every start; errors by hand."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.learning.pieces import AT_ONCE, cut, step_errors
from tests.learning.slopes import Slope, moves, source


def test_each_transition_is_in_one_piece():
    short, long = moves(3, length=2), moves(2, length=5, seed=1)
    pieces = cut([short, long], 3)
    assert pieces.there.sum(1).tolist() == [2, 2, 2, 3, 2, 3, 2]
    assert pieces.origin.tolist() == [0, 1, 2, 3, 3, 4, 4]
    assert pieces.transitions == 3 * 2 + 2 * 5
    kept = np.asarray(pieces.trajectories.actions)[np.asarray(pieces.there)]
    everything = [*np.asarray(short.actions).reshape(-1, 1), *np.asarray(long.actions).reshape(-1, 1)]
    np.testing.assert_array_equal(kept, everything)


def test_pieces_from_every_start_begin_at_every_state_that_something_was_done_in():
    long = moves(2, length=5)
    pieces = cut(long, 3, every=1)
    assert len(pieces) == 10
    np.testing.assert_array_equal(pieces.trajectories.states.x[:, 0], long.states.x[:, :-1].ravel())
    assert pieces.there.sum(1).tolist() == [3, 3, 3, 2, 1] * 2


def test_errors_by_hand_whatever_the_number_of_pieces():
    data = moves(AT_ONCE + 5, length=3, factor=1.5)
    errors = step_errors(source(), cut(data, 2))
    path = 0.5 * np.asarray(data.actions)[..., 0]  # the factor is off by a half
    expected = np.abs(np.stack([path[:, 0], path[:, 0] + path[:, 1]], 1))
    np.testing.assert_allclose(errors[0::2], expected, atol=1e-5)
    np.testing.assert_allclose(errors[1::2, 0], np.abs(path[:, 2]), atol=1e-5)
    assert np.isnan(errors[1::2, 1]).all()  # beyond the end


def test_another_number_of_pieces_compiles_nothing_anew():
    traced = []

    class Counted(Slope):
        def __call__(self, obstacles, state, action):
            traced.append(1)
            return super().__call__(obstacles, state, action)

    for count in (3, 7, 40):
        step_errors(Counted(jnp.ones(())), cut(moves(count), 2))
    assert len(traced) == 1


def test_what_cannot_be_cut():
    with pytest.raises(ValueError, match="there are no trajectories to cut"):
        cut([], 3)
    with pytest.raises(ValueError, match="steps is 0, expected at least 1"):
        cut(moves(2), 0)
    sound = moves(4)
    holed = eqx.tree_at(lambda data: data.states.x, sound, sound.states.x.at[2, 1].set(jnp.nan))
    with pytest.raises(ValueError, match="1 of 8 pieces, of trajectories such as 2, have values"):
        cut(holed, 2)
    other = eqx.tree_at(lambda data: data.actions, sound, jnp.zeros((4, 4, 2)))
    with pytest.raises(ValueError, match="expected equal ones"):
        cut([sound, other], 2)
