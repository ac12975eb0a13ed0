"""Signatures as values: printing, equality, order, distance; blocklists."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.topology import Blocklist, Signature, distance, same

multisets = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), max_size=3)
jitted_distance, jitted_same = jax.jit(distance), jax.jit(same)


def with_room(vectors, slots=3):
    """A signature over two obstacle loops, in a shape that does not depend on the number of vectors."""
    rows = [*sorted(vectors, reverse=True), *[(-1, -1)] * (slots - len(vectors))]
    return Signature(jnp.array(rows), jnp.array(len(vectors)), jnp.array(0.1), jnp.array(False))


def test_it_prints_as_on_paper():
    assert str(Signature.of([(0, 1), (1, 0)], 2)) == "{(1,0),(0,1)}"
    assert str(Signature.of([(1, 1), (1, 1)], 2)) == "{(1,1),(1,1)}"
    assert str(Signature.of([()], 0)) == "{()}"


def test_no_loop_differs_from_a_loop_that_is_linked_with_nothing():
    none, empty = Signature.of([], 2), Signature.of([(0, 0)], 2)
    assert (str(none), str(empty)) == ("∅", "{(0,0)}")
    assert none != empty and not same(none, empty)
    assert int(none.count) == 0
    assert Signature.of([], 0) != Signature.of([()], 0)


@settings(deadline=None)
@given(multisets, st.randoms(use_true_random=False))
def test_order_does_not_matter_and_multiplicity_does(vectors, random):
    shuffled = random.sample(vectors, len(vectors))
    one, other = Signature.of(vectors, 2), Signature.of(shuffled, 2)
    assert one == other and hash(one) == hash(other) and len({one, other}) == 1
    assert eqx.tree_equal(one, other)
    assert one.vectors == tuple(sorted(vectors, reverse=True))
    if vectors:
        assert Signature.of([*vectors, vectors[0]], 2) != one


def test_a_signature_is_equal_to_one_with_more_room():
    roomy = with_room([(1, 0)])
    assert roomy == Signature.of([(1, 0)], 2)
    assert same(roomy, Signature.of([(1, 0)], 2))
    assert roomy != "{(1,0)}"


def least_cost(first, second):
    """All pairings, one by one; None stands for no loop."""
    slots = max(len(first), len(second))
    first, second = ([*vectors, *[None] * (slots - len(vectors))] for vectors in (first, second))

    def cost(one, other):
        if one is None or other is None:
            return 0 if one is other else 1 + sum(one or other)
        return sum(abs(i - j) for i, j in zip(one, other, strict=True))

    return min(sum(map(cost, first, order)) for order in itertools.permutations(second))


@settings(max_examples=40, deadline=None)
@given(multisets, multisets, multisets)
def test_distance_is_the_cheapest_pairing_and_a_metric(first, second, third):
    a, b, c = map(with_room, (first, second, third))
    there, back = jitted_distance(a, b), jitted_distance(b, a)
    assert int(there) == least_cost(first, second) == int(back)
    assert (there == 0) == (a == b) == bool(jitted_same(a, b))
    assert jitted_distance(a, c) <= there + jitted_distance(b, c)


def test_several_grippers_beside_a_goal_of_one_loop():
    # The released code fails here: it subtracts the flattened multisets, of length 6 and 3.
    goal = Signature.of([(1, 1, 0)], 3)
    assert int(distance(Signature.of([(1, 1, 0)], 3), goal)) == 0
    assert int(distance(Signature.of([(0, 1, 0), (1, 0, 0)], 3), goal)) == 1 + (1 + 1)
    assert int(distance(Signature.of([], 3), goal)) == 1 + 2
    # By hand: (1,1,0) is the goal's, (0,0,2) is left over.
    assert int(distance(Signature.of([(0, 0, 2), (1, 1, 0)], 3), goal)) == 1 + 2


@pytest.mark.parametrize(
    ("vectors", "message"),
    [
        ([(1,)], r"\(1,\) is not a vector of a signature; expected 2 whole numbers"),
        ([(1, -1)], r"\(1, -1\) is not a vector"),
    ],
)
def test_what_is_no_signature_is_an_error(vectors, message):
    with pytest.raises(ValueError, match=message):
        Signature.of(vectors, 2)


def test_signatures_over_different_skeletons_cannot_be_compared_and_batches_not_printed():
    one, other = Signature.of([(1, 0)], 2), Signature.of([(1,)], 1)
    assert one != other
    for compare in (same, distance):
        with pytest.raises(ValueError, match="over 2 and over 1 obstacle loops cannot be compared"):
            compare(one, other)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), one)
    with pytest.raises(ValueError, match=r"batch of signatures, of shape \(2,\); choose one"):
        str(batch)


def test_a_blocklist_holds_each_signature_once():
    first, second, third = (Signature.of([vector], 2) for vector in [(1, 0), (0, 1), (2, 2)])
    empty = Blocklist.empty(2, like=first)
    add, contains = jax.jit(Blocklist.add), jax.jit(Blocklist.contains)
    assert not contains(empty, first)
    both = add(add(add(empty, first), second), first)
    assert int(both.length) == 2
    assert contains(both, first) and contains(both, second) and not contains(both, third)
    assert not contains(empty, first), "lists are immutable"
    full = add(both, second)  # known, so there is room
    assert int(full.length) == 2
    with pytest.raises(RuntimeError, match="the blocklist is full with 2 signatures"):
        jax.block_until_ready(both.add(third))
    with pytest.raises(ValueError, match=r"has shape \(0, 2\), those on the blocklist have \(1, 2\)"):
        both.add(Signature.of([], 2))


def test_blocklists_batch():
    signatures = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *[Signature.of([(i, 0)], 2) for i in range(4)]
    )
    lists = jax.vmap(lambda s: Blocklist.empty(3, like=s).add(s))(signatures)
    found = jax.vmap(jax.vmap(Blocklist.contains, (0, None)), (None, 0))(lists, signatures)
    assert (found == jnp.eye(4, dtype=bool)).all()
