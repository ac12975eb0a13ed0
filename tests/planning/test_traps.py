"""Trap detection by hand-made positions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.planning.traps import TrapSettings, regrasped, seen, watched

SETTINGS = TrapSettings(window=4, threshold=0.25, least=0.01)


def after(speeds, settings=SETTINGS, state=None):
    """Ratios and verdicts when all of three coordinates move by so much in each step."""
    state = watched(3, settings) if state is None else state
    here, found = 0.0, []
    for speed in speeds:
        here += speed
        state, trapped, ratio = seen(state, jnp.full(3, here), settings)
        found.append((bool(trapped), float(ratio)))
    return state, found


def test_steady_motion_is_no_trap_and_standing_still_is_one():
    _, found = after([0.1] * 8)
    assert not any(trapped for trapped, _ in found)
    _, found = after([0.1] * 6 + [0.0] * 4)
    # the window of 4 positions moves out of the motion: 3, 2, 1, 0 steps of 0.1 are left in it
    np.testing.assert_allclose([ratio for _, ratio in found[5:]], [1, 2 / 3, 1 / 3, 0, 0], atol=1e-5)
    assert [trapped for trapped, _ in found[5:]] == [False, False, False, True, True]


def test_before_the_window_is_full_nothing_is_a_trap():
    _, found = after([0.0] * 3)
    assert found == [(False, 1.0)] * 3
    _, found = after([0.0] * 4)
    assert found[-1] == (True, 0.0)


def test_what_never_moved_by_much_is_compared_with_the_least():
    # a step of 0.001 makes 3 * 0.001 / 4 in the window; a quarter of 0.01 is more than that
    _, found = after([0.001] * 6)
    assert found[-1] == (True, pytest.approx(0.075, rel=1e-4))


def test_the_change_is_the_mean_of_the_absolute_values():
    state = watched(2, SETTINGS)
    for index in range(4):
        state, _, ratio = seen(state, jnp.array([0.1 * index, -0.1 * index]), SETTINGS)
    assert float(state.highest) == pytest.approx(0.3 / 4, rel=1e-5)
    assert float(ratio) == 1.0


def test_a_regrasp_forgets_the_largest_change_in_the_code_and_keeps_it_in_the_thesis():
    slow = [0.02] * 6  # 0.015 in the window: a tenth of what was fastest, and more than the least
    state, _ = after([0.2] * 6)
    _, found = after(slow, state=regrasped(state, SETTINGS))
    assert not any(trapped for trapped, _ in found)
    thesis = TrapSettings(window=4, threshold=0.25, least=0.01, keeps_highest=True)
    _, found = after(slow, thesis, regrasped(state, thesis))
    assert found[-1] == (True, pytest.approx(0.1, rel=1e-4))
    assert found[2] == (False, 1.0)  # the window began anew


def test_it_runs_inside_jit():
    step = jax.jit(lambda state, position: seen(state, position, SETTINGS))
    state, trapped, _ = step(watched(3, SETTINGS), jnp.zeros(3))
    assert not trapped and int(state.count) == 1


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"window": 1}, "window is 1 positions"),
        ({"threshold": 0.0}, "threshold is 0"),
        ({"least": -1.0}, "least"),
    ],
)
def test_what_detects_nothing_is_refused(values, said):
    with pytest.raises(ValueError, match=said):
        TrapSettings(**values)
