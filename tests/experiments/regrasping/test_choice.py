"""Which candidate each method executes and when a signature is listed, by hand-made candidates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.regrasping.choice import choose, listing, nearest_or_random
from doojax.keys import stream
from doojax.planning.regrasp import Candidates, Strategy
from doojax.planning.regrasp_costs import WEIGHTS
from doojax.topology.signatures import Blocklist, Signature

NOTHING = float("nan")
HERE, THERE = Signature.of([(1, 0)], 2), Signature.of([(0, 1)], 2)


class HandMade:
    """Candidates that grasp with the left hand while the right lets go: places, signatures, feasibility."""

    def __init__(self, now, places, signatures, feasible):
        count = len(places)
        self.now, self._feasible = now, np.array(feasible)
        strategies = np.tile([Strategy.GRASP, Strategy.RELEASE], (count, 1))
        self.candidates = Candidates(strategies, np.stack([places, np.full(count, NOTHING)], 1))
        self.signature_before = HERE
        self.signatures = jax.tree.map(lambda *leaves: jnp.stack(leaves), *signatures)

    def costs(self, blocklist):
        blocked = np.asarray(jax.vmap(blocklist.contains)(self.signatures))
        return 30 * np.abs(self.candidates.places[:, 0] - 1) + WEIGHTS.blocklist * blocked

    def fits(self):
        raise NotImplementedError  # no signature is wanted

    foreseen = fits  # nor does anything look ahead

    def best(self, costs):
        values = np.where(self._feasible, costs(self), np.inf)
        return int(np.argmin(values)) if self._feasible.any() else None


def chosen(method, choices, listed=()):
    blocklist = Blocklist.empty(4, like=HERE)
    for one in listed:
        blocklist = blocklist.add(one)
    found, after = choose(method, choices, blocklist, 1.0, stream(0, "test"))
    return found, listing(after)


NEARER = HandMade((NOTHING, 0.5), [0.8, 0.2], [HERE, THERE], [True, True])
NO_NEARER = HandMade((NOTHING, 0.9), [0.91, 0.8, 0.2], [HERE, HERE, THERE], [True, True, True])


def test_a_nearer_grasp_of_the_same_signature_is_taken_without_listing_it():
    assert chosen("signature", NEARER) == (0, [])


def test_where_nothing_is_nearer_the_signature_is_listed_and_another_is_taken():
    assert chosen("signature", NO_NEARER) == (2, ["{(1,0)}"])


def test_always_listing_gives_up_a_nearer_grasp():
    assert chosen("always_blocklist", NEARER) == (1, ["{(1,0)}"])


def test_without_the_signature_the_nearest_is_taken_though_it_failed():
    assert chosen("no_signature", NO_NEARER) == (0, [])


def test_what_was_listed_before_stays_listed():
    assert chosen("signature", NEARER, [HERE]) == (1, ["{(1,0)}"])


def test_nobody_holding_the_rope_nothing_is_listed():
    free = HandMade((NOTHING, NOTHING), [0.8, 0.2], [HERE, THERE], [True, True])
    assert chosen("signature", free) == (0, [])
    assert chosen("always_blocklist", free) == (0, [])


def test_nothing_feasible_chooses_nothing():
    none = HandMade((NOTHING, 0.5), [0.8, 0.2], [HERE, THERE], [False, False])
    for method in ("signature", "no_signature", "nearest"):
        assert chosen(method, none)[0] is None


@pytest.mark.parametrize(("now", "expected"), [(0.5, 0), (0.79, 1)])
def test_the_simple_baseline_takes_the_nearest_or_any(now, expected):
    places = np.array([[0.8, NOTHING], [0.2, NOTHING]])
    found = nearest_or_random(places, (NOTHING, now), 1.0, np.array([0.9, 0.1]))
    assert int(np.argmin(found)) == expected
    assert (found[expected] < 1) == (expected == 0)  # what is not nearer comes after all that is
