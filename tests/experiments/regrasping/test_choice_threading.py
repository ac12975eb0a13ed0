"""Which candidate each method of threading executes, and what TAMP looks at, by hand-made candidates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.regrasping.choice import choose, choose_threading, stuck_counts
from doojax.experiments.regrasping.trial import check_method
from doojax.keys import stream
from doojax.planning.regrasp import Candidates, Strategy
from doojax.tasks.threading import threading
from doojax.tasks.untangling import untangling
from doojax.topology.signatures import Blocklist, Signature

NOTHING = float("nan")
WANTED, WITHOUT = Signature.of([(1, 0, 0)], 3), Signature.of([(0, 0, 0)], 3)


class HandMade:
    """The left hand grasps, the right then lets go; the first candidate is cheapest but for its signature."""

    def __init__(self, places, signatures, feasible, ahead, goal=None):
        count = len(places)
        self.now, self._feasible, self._ahead, self.goal = (NOTHING, 0.93), feasible, ahead, goal
        strategies = np.tile([Strategy.GRASP, Strategy.RELEASE], (count, 1))
        self.candidates = Candidates(strategies, np.stack([places, np.full(count, NOTHING)], 1))
        self.signature_before = WITHOUT
        self.signatures = jax.tree.map(lambda *leaves: jnp.stack(leaves), *signatures)

    def costs(self, blocklist):
        off = 100.0 * ~self.fits() if self.goal is not None else 0.0
        return 30 * np.abs(self.candidates.places[:, 0] - 1) + off

    def fits(self):
        count = len(self.candidates)
        own = [jax.tree.map(lambda leaf, i=i: leaf[i], self.signatures) for i in range(count)]
        return np.array([one == self.goal for one in own])

    def foreseen(self):
        return np.array(self._ahead)

    def best(self, costs):
        values = np.where(self._feasible, costs(self), np.inf)
        return int(np.argmin(values)) if np.any(self._feasible) else None


def made(goal=None, feasible=(True, True), ahead=(0.0, 0.0)):
    return HandMade(np.array([1.0, 0.96]), [WITHOUT, WANTED], np.array(feasible), ahead, goal)


def chosen(method, choices, must_fit=True):
    empty = Blocklist.empty(2, like=WANTED)
    return choose_threading(method, choices, empty, 1.0, stream(0, "test"), must_fit=must_fit)


def test_the_signature_takes_what_leads_to_the_wanted_one():
    assert chosen("signature", made(WANTED)) == 1


def test_on_the_disc_the_signature_refuses_what_does_not_and_elsewhere_takes_it():
    lost = made(WANTED, feasible=(True, False))
    assert chosen("signature", lost, must_fit=True) is None
    assert chosen("signature", lost, must_fit=False) == 0


def test_without_the_signature_the_nearest_is_taken():
    assert chosen("no_signature", made()) == 0
    assert chosen("wang", made()) == 0
    assert chosen("wang", made(feasible=(False, False))) is None


def test_tamp_takes_where_control_then_gets():
    assert chosen("tamp5", made(ahead=(2.0, 0.5))) == 1
    assert chosen("tamp50", made(ahead=(0.5, 2.0))) == 0
    assert chosen("tamp5", made(ahead=(1.0, 0.0))) == 0  # 1.2 for the way along the rope outweighs it
    empty = Blocklist.empty(2, like=WANTED)
    found, after = choose("tamp5", made(ahead=(2.0, 0.5)), empty, 1.0, stream(0, "test"))
    assert found == 1 and int(after.length) == 0  # nothing is listed


def test_wang_looks_whether_it_is_stuck_only_beside_the_fixture():
    centre, near, far = np.zeros(3), np.array([[0.05, 0.05, 0]]), np.array([[0.06, 0.06, 0]])
    assert stuck_counts("wang", near, centre) and not stuck_counts("wang", far, centre)
    assert not stuck_counts("wang", np.zeros((0, 3)), centre)  # nobody holds the rope
    assert stuck_counts("signature", far, centre)


def test_methods_are_those_of_the_task():
    with pytest.raises(ValueError, match="threading lists no signatures"):
        chosen("always_blocklist", made())
    with pytest.raises(ValueError, match="wang only threads"):
        choose("wang", made(), Blocklist.empty(2, like=WANTED), 1.0, stream(0, "test"))
    with pytest.raises(ValueError, match="unknown method 'wang', expected some of signature"):
        check_method(untangling(), "wang")
    assert check_method(threading(), "wang") == "wang"
