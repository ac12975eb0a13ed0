"""Linking numbers against known links, an oracle in other formulas, and what must not change them."""

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.topology import TOUCHING, linking_number, linking_of, rectangle

from . import curves
from .oracle import oracle_linking_number, oracle_margin

ROUNDING = 2e-6  # of the margin, in bounding boxes, as promised
KINDS = ["any", "lattice", "boxes", "strands", "far"]

one = jax.jit(linking_of)
many_on_device = jax.jit(jax.vmap(linking_of))


def many(first, second):
    return jax.tree.map(np.asarray, many_on_device(first, second))  # JAX would compile every choice of pairs


def size_of(first, second):
    return np.ptp(np.concatenate([first, second], axis=-2), axis=-2).max(axis=-1)


def pad(loops, count):
    return np.pad(loops, [(0, 0)] * (loops.ndim - 2) + [(0, count - loops.shape[-2]), (0, 0)], mode="edge")


# Known links


@pytest.mark.parametrize("k", [-5, -2, -1, 0, 1, 2, 3, 7])
def test_torus_links_are_linked_k_times(k):
    first, second = curves.torus_link(k)
    assert oracle_linking_number(first, second)[0] == k
    assert linking_number(first, second) == k


def test_the_whitehead_link_has_linking_number_zero_though_it_cannot_be_pulled_apart():
    first, second = curves.whitehead_link()
    result = one(first, second)
    assert (int(result.number), bool(result.touching)) == (0, False)
    assert result.margin > 0.1


def test_borromean_rings_are_pairwise_not_linked():
    rings = curves.borromean_rings()
    for first in range(3):
        for second in range(3):
            if first != second:
                assert linking_number(rings[first], rings[second]) == 0


def test_a_positive_hopf_link_by_hand():
    # The first loop passes up through the second, which turns counter-clockwise seen from above.
    up = curves.closed([[0, 0, -1], [0, 0, 1], [5, 0, 1], [5, 0, -1]])
    square = curves.closed([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    assert linking_number(up, square) == 1
    assert linking_number(up[::-1], square) == -1
    assert float(one(up, square).margin) == pytest.approx(1, abs=6 * ROUNDING)


# Random pairs


def along_axes(rng, count):
    """Loops of 12 points that go from one lattice point to the next along x, then y, then z."""
    corners = rng.integers(-4, 5, size=(count, 4, 3)).astype(float)
    after = np.roll(corners, -1, axis=1)
    steps = [np.where(np.arange(3) < moved, after, corners) for moved in range(3)]
    return np.stack(steps, axis=2).reshape(count, 12, 3)


def random_pairs(rng, kind, count, first_points, second_points):
    """Pairs of loops of at most 13 points; the kinds provoke what is hard."""
    first = rng.normal(size=(count, first_points, 3))
    second = rng.normal(size=(count, second_points, 3))
    if (
        kind == "lattice"
    ):  # vertices above each other; segments parallel, vertical or without length; touching
        first = np.round(2 * first)
        second = np.round(2 * second) + rng.choice([0, 0, 0.5], size=(count, 1, 3))
    if kind == "boxes":  # every segment along an axis
        first, second = (
            along_axes(rng, count),
            along_axes(rng, count) + rng.choice([0, 0.5], size=(count, 1, 3)),
        )
    if kind == "strands":  # one beside the other all along, as near as 1e-4 of the size
        near = rng.choice([1e-4, 1e-3, 1e-2], size=(count, 1, 1)) * size_of(first, first)[:, None, None]
        second = first + near * rng.normal(size=(count, 1, 3)) + 0.1 * near * rng.normal(size=first.shape)
    if kind == "far":  # from the origin
        first, second = first + 30, second + 30
    close = lambda loops: pad(np.concatenate([loops, loops[:, :1]], axis=1), 13)  # noqa: E731
    return close(first), close(second)


pair_arguments = {
    "seed": st.integers(0, 2**32 - 1),
    "kind": st.sampled_from(KINDS),
    "first_points": st.integers(3, 12),
    "second_points": st.integers(3, 12),
}


@settings(max_examples=100, deadline=None)
@given(**pair_arguments)
def test_ten_thousand_random_pairs_agree_with_the_oracle(seed, kind, first_points, second_points):
    pairs = random_pairs(np.random.default_rng(seed), kind, 100, first_points, second_points)
    first, second = (loops.astype(np.float32) for loops in pairs)
    results = many(first, second)
    size, margin = size_of(first, second), oracle_margin(first, second)
    np.testing.assert_array_less(np.abs(results.margin - margin), ROUNDING * size)
    clear = np.abs(margin - TOUCHING * size) > ROUNDING * size
    np.testing.assert_array_equal(results.touching[clear], (margin < TOUCHING * size)[clear])
    apart = ~results.touching
    number, doubt = oracle_linking_number(first[apart], second[apart])
    np.testing.assert_array_less(doubt, 1e-3)
    np.testing.assert_array_equal(results.number[apart], number)


@settings(max_examples=20, deadline=None)
@given(**pair_arguments)
def test_what_does_not_change_a_linking_number(seed, kind, first_points, second_points):
    rng = np.random.default_rng(seed)
    first, second = random_pairs(rng, kind, 20, first_points, second_points)
    number, margin = oracle_linking_number(first, second)[0], oracle_margin(first, second)
    keep = margin > 3e-5 * size_of(first, second)  # transformed, still above TOUCHING

    turn, shift, scale = curves.random_rotation(rng), rng.normal(size=3), 10 ** rng.uniform(-3, 3)
    middle = (first[:, :1] + second[:, :1]) / 2
    moved = [(loops - middle) @ turn.T + shift for loops in (first, second)]
    points = 12 if kind == "boxes" else first_points
    start, open_first = rng.integers(points), first[:, :points]
    shifted = pad(np.concatenate([open_first[:, start:], open_first[:, : start + 1]], axis=1), 13)
    within = rng.uniform(size=(20, 12, 1))  # a new point on every segment
    finer = np.stack([first[:, :-1], first[:, :-1] + within * np.diff(first, axis=1)], axis=2)
    finer = np.concatenate([finer.reshape(20, 24, 3), first[:, -1:]], axis=1)

    for changed, sign, scaled in [
        ((second, first), 1, 1),
        ((first[:, ::-1], second), -1, 1),
        ((first, second[:, ::-1]), -1, 1),
        ((first[:, ::-1], second[:, ::-1]), 1, 1),
        ((shifted, second), 1, 1),
        ((finer, second), 1, 1),
        (moved, 1, 1),
        ([scale * (loops - middle) for loops in (first, second)], 1, scale),
        ([loops * [1, 1, -1] for loops in (first, second)], -1, 1),  # in a mirror
    ]:
        results = many(*changed)
        np.testing.assert_array_equal(results.number[keep], sign * number[keep])
        error = np.abs(results.margin - margin * scaled)
        np.testing.assert_array_less(error, 1e-5 * scaled * size_of(first, second))


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_motion_that_keeps_the_curves_apart_keeps_the_linking_number(seed):
    rng = np.random.default_rng(seed)
    pairs = np.stack(random_pairs(rng, "any", 200, 4, 4))
    pairs = pairs[:, oracle_margin(*pairs) > 0.05]
    start, before, way = pairs.copy(), many(*pairs).number, np.zeros_like(pairs)
    for _ in range(60):
        # No point moves half the margin in a step, so the curves cannot meet on the way.
        margin = many(*pairs).margin
        step = 0.45 * margin[:, None, None] * way
        kept = way.any(axis=(0, 2, 3)) & (many(*(pairs + step)).margin > 0.05)
        pairs[:, kept] += step[:, kept]
        fresh = rng.normal(size=(2, np.sum(~kept), 4, 3))  # another way for those that would come too close
        fresh /= np.linalg.norm(fresh, axis=-1).max(axis=-1)[..., None, None]
        way[:, ~kept] = pad(np.concatenate([fresh, fresh[..., :1, :]], axis=-2), 13)
    np.testing.assert_array_equal(many(*pairs).number, before)
    assert np.abs(pairs - start).mean() > 0.2, "they moved"


@settings(max_examples=25, deadline=None)
@given(**pair_arguments)
def test_single_precision_equals_double_wherever_the_margin_exceeds_1e_4(
    seed, kind, first_points, second_points
):
    first, second = random_pairs(np.random.default_rng(seed), kind, 50, first_points, second_points)
    single = many(first.astype(np.float32), second.astype(np.float32))
    with jax.enable_x64(True):
        double = many(first, second)
        assert double.margin.dtype == np.float64
    clear = oracle_margin(first, second) > 1e-4 * size_of(first, second)
    assert not single.touching[clear].any() and not double.touching[clear].any()
    np.testing.assert_array_equal(single.number[clear], double.number[clear])
    np.testing.assert_array_equal(double.number[clear], oracle_linking_number(first[clear], second[clear])[0])


# Where a quadrature goes wrong

# Case 1 of the released package's tests.
LOOP = curves.closed([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
OBSTACLE = curves.closed([[0.5, -0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 1.5], [0.5, -0.5, 1.5]])


@pytest.mark.parametrize("scale", [1, 0.5, 0.1, 0.05, 1e-3, 1e4])
def test_scaled_copies_have_one_linking_number(scale):
    assert abs(linking_number(scale * LOOP, scale * OBSTACLE)) == 1
    assert linking_number(scale * LOOP[::-1], scale * OBSTACLE) == -linking_number(
        scale * LOOP, scale * OBSTACLE
    )


@pytest.mark.parametrize(("height", "number"), [(0.2, 0), (0.6, 0), (1.2, 0)])
def test_a_ring_beside_the_post_it_does_not_enclose(height, number):
    skeleton = curves.closed([[0.5, -2.5, -3.4], [0.5, 0.5, -3.4], [0.5, 0.5, 1.8], [0.5, -2.5, 1.8]])
    assert linking_number(curves.circle(0.25, (0, 0, height)), skeleton) == number


def test_two_ropes_with_common_ends_go_the_same_way_if_there_and_back_is_linked_with_nothing():
    t = np.linspace(0, 1, 9)[:, None]
    frames = [rectangle([x, 0, 0], [0, 0.3, 0], [0, 0, 0.3]) for x in (0.5, 1.5)]

    def rope(*heights, beside=0.02):  # metres between its ends and those of the other rope
        along = np.interp(8 * t, np.arange(9), [0, *heights, 0])
        return np.concatenate([2 * t, 0 * t, along + beside], axis=1)

    straight = rope(*[0] * 7, beside=0)
    also_straight, over_first, over_both = (
        rope(0, 0.1, 0, 0, -0.1, 0, 0),
        rope(1, 1, 1, 0, 0, 0, 0),
        rope(*[1] * 7),
    )
    for goal, expected in [(also_straight, [0, 0]), (over_first, [1, 0]), (over_both, [1, 1])]:
        there_and_back = curves.closed(np.concatenate([straight, goal[::-1]]))
        assert [abs(linking_number(there_and_back, frame)) for frame in frames] == expected


def long_segment_among_many(offset=0.0):
    """44 vertices: 4 m straight through a ring 0.12 m wide, and a fine way back around it."""
    back = 2 * np.exp(1j * curves.turns(84)[1:42])
    points = [[-2, 0, 0], [2, 0, 0], *np.stack([back.real, back.imag, np.zeros(41)], axis=1)]
    return curves.closed(np.add(points, [0, offset, 0]))


def square_ring(side):
    h = side / 2
    return curves.closed([[0, -h, -h], [0, h, -h], [0, h, h], [0, -h, h]])


@pytest.mark.parametrize("offset", [0, 0.05, 0.059, 0.0599])  # the last two are 1 mm and 0.1 mm from the wire
def test_a_long_segment_through_a_small_ring(offset):
    path, ring = long_segment_among_many(offset), square_ring(0.12)
    assert abs(linking_number(path, ring)) == 1
    assert linking_number(long_segment_among_many(0.0601), ring) == 0
    assert float(one(path, ring).margin) == pytest.approx(0.06 - offset, abs=4 * ROUNDING)


def test_the_released_quadrature_is_wrong_there():
    released = pytest.importorskip("h_signature.h_signature_np")
    path = long_segment_among_many(0.05)
    assert released.get_h_signature(path, {"ring": square_ring(0.12)}) != (1,)
    assert abs(linking_number(path, square_ring(0.12))) == 1
    # An open path gets an answer from it.
    assert released.get_h_signature(np.array([[0.0, 0, 0], [1, 0, 0]]), {"ring": square_ring(1.0)}) == (0,)


# Bad input


def test_an_open_path_is_an_error():
    with pytest.raises(ValueError, match=r"first loop has 2 points; expected at least three"):
        linking_number([[0, 0, 0], [1, 0, 0]], curves.circle(0.5, axes=(1, 2)))
    with pytest.raises(ValueError, match=r"second loop is open: it begins at \[0.0, 0.0, 0.0\] and ends at"):
        linking_number(LOOP, LOOP[:-1])


@pytest.mark.parametrize(
    ("loop", "message"),
    [
        (
            curves.closed([[0, 0, 0], [1, 0, 0]]),
            "first loop has 3 points; expected at least three, and the first one again",
        ),
        (np.where(np.arange(5)[:, None] == 2, np.nan, LOOP), "first loop is not finite at point 2"),
        (np.insert(LOOP, 2, LOOP[2], axis=0), "first loop has a segment without length at point 2"),
        (LOOP[:, :2], r"first loop has shape \(5, 2\)"),
        ([[0, 0, 0], [1, 0]], "first loop is no list of points"),
        ([], "first loop has 0 points"),
        (np.full((4, 3), "a"), "first loop has shape .* and type <U1"),
    ],
)
def test_what_is_no_loop_is_an_error_that_says_where(loop, message):
    with pytest.raises(ValueError, match=message):
        linking_number(loop, OBSTACLE)


TOUCHING_PAIRS = {
    "crossing": (LOOP, np.add(OBSTACLE, [0, 0, -0.5])),
    "vertex on segment": (LOOP, np.add(OBSTACLE, [0, -0.5, -0.5])),
    "shared vertex": (LOOP, np.add(OBSTACLE, [-0.5, 0.5, -0.5])),
    "shared segment": (LOOP, curves.closed([[0, 0, 0], [1, 0, 0], [1, 5, 0], [0, 5, 0]])),
    "the same": (LOOP, LOOP),
    "nearly": (LOOP, np.add(OBSTACLE, [0, 0, -0.5 + 1e-6])),
}


@pytest.mark.parametrize("name", TOUCHING_PAIRS)
def test_curves_that_touch_are_reported(name):
    first, second = TOUCHING_PAIRS[name]
    assert one(first, second).touching
    assert one(second, first).touching
    with pytest.raises(ValueError, match=r"the loops touch: .* move them apart"):
        linking_number(first, second)


def test_under_jit_malformed_input_counts_as_touching_and_its_margin_is_nan():
    with_nan, infinite = LOOP.copy(), LOOP.copy()
    with_nan[2, 1], infinite[1, 0] = np.nan, np.inf
    point = np.zeros((4, 3))
    for first, second in [(LOOP[:-1], OBSTACLE), (with_nan, OBSTACLE), (OBSTACLE, infinite), (point, point)]:
        result = one(first, second)
        assert np.isnan(result.margin) and result.touching


def test_padding_changes_nothing():
    plain, more = one(LOOP, OBSTACLE), one(pad(LOOP, 9), pad(OBSTACLE, 40))
    assert eqx.tree_equal(plain, more)


def test_a_batch_is_compiled_once_and_equals_its_elements():
    rng = np.random.default_rng(0)
    counted = eqx.debug.assert_max_traces(max_traces=1)(linking_of)
    batched = jax.jit(jax.vmap(jax.vmap(counted, (None, 0)), (0, None)))
    first, second = (loops.astype(np.float32) for loops in random_pairs(rng, "any", 6, 12, 12))
    batched(first + 1, second)
    table = batched(first, second)
    for i in range(6):
        for j in range(6):
            single = one(first[i], second[j])
            assert int(single.number) == int(table.number[i, j])
            assert float(single.margin) == pytest.approx(float(table.margin[i, j]), rel=1e-5)
