"""Rules of threading by hand-made loops and ropes: the way through, the disc, subgoals, the field's cost."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.regrasping import threading as module
from doojax.experiments.regrasping.control import along_field
from doojax.experiments.regrasping.run import RegraspSettings, Run
from doojax.experiments.regrasping.threading import (
    Threading,
    is_penetrated,
    normal_of,
    pushed_back,
    subgoals,
)
from doojax.topology.linking import linking_number
from doojax.topology.signatures import Blocklist, Signature
from doojax.topology.skeletons import rectangle

# a frame of 20 by 10 cm about the x axis, whose field runs along +x
LOOP = rectangle((0.0, 0.0, 1.0), (0, 0.1, 0), (0, 0, 0.05))
CORNER = float(np.hypot(0.1, 0.05))


def test_the_way_through_is_the_fields():
    np.testing.assert_allclose(normal_of(LOOP), [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(normal_of(LOOP[::-1]), [-1, 0, 0], atol=1e-6)
    # a curve that goes that way is linked once, with a positive sign
    curve = np.array([[-1, 0, 1], [1, 0, 1], [1, 5, 1], [-1, 5, 1], [-1, 0, 1]], float)
    assert linking_number(curve, LOOP) == 1


@pytest.mark.parametrize(
    ("tip", "expected"),
    [
        ((0.01, 0, 1), True),
        ((-0.01, 0, 1), False),  # before it
        ((0.3, 0, 1), True),  # how far behind does not matter
        ((0.01, 0, 1 + CORNER - 1e-3), True),  # the disc is as large as the farthest corner
        ((0.01, 0, 1 + CORNER + 1e-3), False),
    ],
)
def test_the_disc_is_penetrated_behind_the_loop_and_within_its_corners(tip, expected):
    assert bool(is_penetrated(LOOP, np.array(tip))) == expected


def test_subgoals_go_through_one_loop_more_each_in_their_order():
    found = subgoals(("a", "b", "c"), ("c", "a"))
    assert found == [Signature.of([(0, 0, 1)], 3), Signature.of([(1, 0, 1)], 3)]


def test_control_pushes_on_no_farther_back_than_where_the_hand_holds():
    assert pushed_back(1.0, 0.93) == pytest.approx(0.995)
    assert pushed_back(0.932, 0.93) == 0.93


COST = jax.jit(lambda rope, keypoint: along_field(rope, keypoint, jnp.asarray(LOOP, jnp.float32)))


def moved(step, count=3):
    """A rope of two links before the loop that moves by ``step`` once."""
    rope = np.array([[-0.4, 0, 1], [-0.3, 0, 1], [-0.2, 0, 1]], np.float32)[:count]
    return jnp.asarray(np.stack([rope, rope + np.array(step, np.float32)]))


def test_moving_along_the_field_costs_nothing_against_it_half_a_turn_across_a_quarter():
    cost = lambda rope: COST(rope, 1.0)  # noqa: E731
    weights = np.exp(-20 * np.array([1, 0.5, 0])).sum()
    assert cost(moved((0.01, 0, 0))) == pytest.approx(0, abs=1e-3)
    assert cost(moved((-0.01, 0, 0))) == pytest.approx(np.pi * weights, rel=1e-3)
    assert cost(moved((0, 0.01, 0))) == pytest.approx(np.pi / 2 * weights, rel=1e-3)
    assert cost(moved((0, 0, 0))) == pytest.approx(np.pi / 2 * weights, rel=1e-3)  # it does not move


def test_points_count_by_how_near_they_are_to_the_keypoint():
    one = moved((0, 0, 0)).at[1, 2].add(jnp.array([0.01, 0, 0]))  # the end alone moves, along the field
    right, end, middle = np.pi / 2, np.exp(0), np.exp(-10)
    found = COST(one, 1.0)
    assert found == pytest.approx(right * (middle + np.exp(-20)), abs=2e-6)
    found = COST(one, 0.0)
    assert found == pytest.approx(right * (end + middle), rel=1e-3)


NOTHING = float("nan")


class Played(Run):
    """A run whose tip, signature and plans are given: what algorithm 7 does with them is told by ``said``."""

    def __init__(self, method="signature", held=(NOTHING, 0.93), tip=(0.01, 0, 1), after=(1,), chosen=0):
        names = ("a",)
        task = SimpleNamespace(threads=("a",), keypoint=1.0)
        base = np.array(module.BASE)
        skeleton = SimpleNamespace(names=names, loops=np.array([LOOP - base]))
        self.world = SimpleNamespace(task=task, skeleton=skeleton)  # pyright: ignore
        self.method, self._held, self._tip, self._after, self._chosen = method, held, tip, after, chosen
        self.settings = RegraspSettings()
        self.signature, self.goal = Signature.of([(0,)], 1), np.ones(3)
        self.blocklist = Blocklist.empty(2, like=self.signature)
        self.said: list = []

    def places(self):
        return self._held

    def planned(self, candidates, keypoint, aim, key, *, goal=None, holds_on=False):  # pyright: ignore
        self.said.append((round(keypoint, 6), goal, holds_on, len(candidates), aim.loop is None))
        return None

    def regrasp(self, plans, chosen, since, iteration, about):
        if chosen is not None:
            self.signature = Signature.of([self._after], 1)
        return chosen is not None

    def start_anew(self):
        self.said.append("anew")


@pytest.fixture
def played(monkeypatch):
    """Algorithm 7 with plans that are given."""

    def inner(**given):
        run = Played(**given)
        monkeypatch.setattr(module, "choose_threading", lambda *_, must_fit: run._chosen)
        return run, Threading(run)

    return inner


KEY = jax.random.key(0)


def test_on_the_disc_a_grasp_at_the_tip_is_looked_for_and_the_other_hand_holds_on(played):
    run, algorithm = played()
    assert algorithm.regrasped(0, KEY, on_disc=True)
    assert run.said == [(1.0, Signature.of([(1,)], 1), True, 10, True), "anew"]  # then on to the goal
    algorithm.advance(True)
    assert algorithm.subgoal == 1


def test_where_control_is_stuck_the_grasp_is_a_little_behind_the_hand(played):
    run, algorithm = played(after=(0,))
    assert algorithm.regrasped(0, KEY, on_disc=False)
    assert run.said[0] == (0.88, Signature.of([(1,)], 1), True, 10, False)  # on the way to the same fixture
    algorithm.advance(True)
    assert algorithm.subgoal == 0  # the executed signature is not the wanted one
    run, algorithm = played(held=(NOTHING, NOTHING))
    algorithm.regrasped(0, KEY, on_disc=False)
    assert run.said[0][0] == 0.95 and run.said[0][3] == 20  # nobody holds: either hand may


def test_without_a_grasp_control_pushes_on(played):
    _, algorithm = played(chosen=None)
    assert not algorithm.regrasped(0, KEY, on_disc=True)
    assert algorithm.aimed == pytest.approx(0.995)


def test_others_go_on_when_they_have_regrasped_whatever_the_signature(played):
    run, algorithm = played(method="wang", after=(0,))
    algorithm.regrasped(0, KEY, on_disc=True)
    assert run.said[0][1] is None and run.said[0][3] == 1  # one candidate, and no wanted signature
    algorithm.advance(True)
    assert algorithm.subgoal == 1
