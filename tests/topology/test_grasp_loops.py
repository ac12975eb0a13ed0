"""Grasp loops and signatures: the known table, algorithm 4 to the letter, bad input, compilation."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import networkx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.topology import (
    Grasps,
    Holder,
    linking_of,
    loops_of,
    make_grasps,
    make_skeleton,
    rectangle,
    signature,
)

from . import curves
from .oracle import oracle_linking_number, oracle_margin

jitted = jax.jit(signature, static_argnames="remove_empty")
all_pairs = jax.jit(jax.vmap(jax.vmap(linking_of, (None, 0)), (0, None)))
polylines = jax.jit(loops_of)

# A straight rope along x, a base beside it, and square loops around the rope at x = 0.5 and x = 1.5.
ROPE = np.stack([np.linspace(0, 2, 11), np.ones(11), np.zeros(11)], axis=1)
BASE = np.array([1.0, -2, 0])
SKELETON = make_skeleton(
    {name: rectangle([x, 1, 0], [0, 0.2, 0], [0, 0, 0.2]) for name, x in [("A", 0.5), ("B", 1.5)]}
)
BELOW = [[1, -2, -0.8], [0, 1, -0.8]]


def straight_arms(*locations, attached=True, below=True):
    grippers = {f"g{place}": Holder(location) for place, location in enumerate(locations)}
    attachments = {"a0": Holder(0.0, BELOW if below else ())} if attached else {}
    return make_grasps(ROPE, BASE, grippers, attachments, max_grippers=2, max_attachments=1)


@pytest.mark.parametrize("remove_empty", [True, False])
@pytest.mark.parametrize(
    ("grasps", "skeleton", "printed"),
    [
        (straight_arms(), SKELETON, "∅"),
        (straight_arms(0.9, attached=False), SKELETON, "∅"),
        (straight_arms(0.1), SKELETON, "{(0,0)}"),
        (straight_arms(0.9), SKELETON, "{(1,1)}"),
        (straight_arms(0.9, 0.4), SKELETON, "{(1,0),(0,1)}"),
        (straight_arms(0.4, 0.9), SKELETON, "{(1,0),(0,1)}"),
        (straight_arms(0.9), make_skeleton({}), "{()}"),
        (straight_arms(0.9, below=False), SKELETON, "{(1,1)}"),
    ],
)
def test_the_known_table(grasps, skeleton, printed, remove_empty):
    found = jitted(grasps, skeleton, remove_empty=remove_empty)
    assert str(found) == printed
    assert not found.touching


@pytest.mark.parametrize(
    ("grasps", "removed", "kept"),
    [
        (straight_arms(0.1, 0.2), "{(0,0)}", "{(0,0),(0,0)}"),
        (straight_arms(0.8, 0.9), "{(1,1)}", "{(1,1),(0,0)}"),
        (straight_arms(0.8, 0.9, attached=False), "∅", "{(0,0)}"),
        (straight_arms(0.1, 0.9, attached=False), "{(1,1)}", "{(1,1)}"),
    ],
)
def test_loops_of_two_grippers_that_are_linked_with_nothing_can_be_removed(grasps, removed, kept):
    assert str(jitted(grasps, SKELETON)) == removed
    assert str(jitted(grasps, SKELETON, remove_empty=False)) == kept


def test_drones_that_carry_a_hose_through_a_fork():
    # The hose lies along x; its last quarter was passed through a fork in a tree. The drones fly above it
    # and have a virtual hub above them all.
    hose = np.stack([np.linspace(0, 4, 9), np.zeros(9), -0.1 * np.sin(np.linspace(0, 9, 9))], axis=1)
    fork = make_skeleton({"fork": rectangle([3, 0, 0], [0, 0.5, 0], [0, 0, 0.5])})

    def held_at(*locations):
        drones = {str(place): Holder(place, [[4 * place, 0, 1]]) for place in locations}
        return jitted(make_grasps(hose, [2, 0, 5], drones, max_grippers=3), fork, remove_empty=False)

    assert str(held_at(0.0, 0.5)) == "{(0)}"
    assert str(held_at(0.0, 0.5, 0.7)) == "{(0),(0)}", "the third lifts on this side of the fork"
    assert str(held_at(0.0, 0.5, 1.0)) == "{(1),(0)}", "and here behind it"
    assert str(held_at(1.0)) == "∅"


# Algorithm 4 to the letter


def literal_algorithm(grasps, obstacles, remove_empty):
    """Vertices, edges, cycles of three, loops, and starting again whenever a gripper is removed."""
    rope, base = np.asarray(grasps.rope, float), np.asarray(grasps.base, float)
    knots = np.linspace(0, 1, len(rope))
    place = {}
    for kind, locations, active, paths in [
        ("g", grasps.gripper_locations, grasps.gripping, grasps.gripper_paths),
        ("a", grasps.attachment_locations, grasps.attached, grasps.attachment_paths),
    ]:
        for i in np.flatnonzero(active):
            place[kind, int(i)] = float(locations[i]), np.asarray(paths[i], float)

    def point(location):
        return np.array([np.interp(location, knots, rope[:, axis]) for axis in range(3)])

    def path(one, other):
        if "base" in (one, other):
            end = other if one == "base" else one
            points = [base, *place[end][1], point(place[end][0])]
            return points if one == "base" else points[::-1]
        start, stop = place[one][0], place[other][0]
        inner = [p for knot, p in zip(knots, rope, strict=True) if min(start, stop) < knot < max(start, stop)]
        return [point(start), *(inner if start < stop else inner[::-1]), point(stop)]

    while True:
        graph = networkx.Graph()
        graph.add_nodes_from(["base", *place])
        graph.add_edges_from(("base", vertex) for vertex in place)
        for one, other in itertools.combinations(place, 2):
            low, high = sorted([place[one][0], place[other][0]])
            if not any(low < location < high for location, _ in place.values()):
                graph.add_edge(one, other)
        cycles = [c for c in networkx.simple_cycles(graph, length_bound=3) if len(c) == 3 and "base" in c]
        cycles = [c for c in cycles if any(vertex[0] == "g" for vertex in c if vertex != "base")]
        vectors, to_remove = [], None
        for cycle in cycles:
            loop = np.concatenate(
                [path(one, other) for one, other in zip(cycle, cycle[1:] + cycle[:1], strict=True)]
            )
            loop = curves.closed(loop)
            vector = tuple(int(abs(oracle_linking_number(loop, obstacle)[0])) for obstacle in obstacles)
            vectors.append(vector)
            grippers = [vertex for vertex in cycle if vertex != "base" and vertex[0] == "g"]
            if not any(vector) and len(grippers) == 2:
                to_remove = max(grippers)
        if to_remove is None or not remove_empty:
            return tuple(sorted(vectors, reverse=True))
        del place[to_remove]


def random_state(rng, grippers=3, attachments=2):
    junk = [np.nan, np.inf, 7.0]
    gripping, attached = rng.random(grippers) < 0.8, rng.random(attachments) < 0.7
    paths, locations = rng.normal(size=(grippers, 2, 3)), rng.random(grippers)
    paths[~gripping], locations[~gripping] = rng.choice(junk), rng.choice(junk)
    attachment_paths = rng.normal(size=(attachments, 3, 3))
    attachment_paths[~attached] = rng.choice(junk)
    fields = [rng.normal(size=(9, 3)), rng.normal(size=3), paths, locations, gripping]
    return Grasps(*map(jnp.asarray, [*fields, attachment_paths, rng.random(attachments), attached]))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_random_states_agree_with_algorithm_4_to_the_letter(seed):
    rng = np.random.default_rng(seed)
    state = random_state(rng)
    small = 0.6 * rng.normal(size=(3, 3, 3)) + 0.5 * rng.normal(size=(3, 1, 3))  # many loops miss them
    obstacles = [curves.closed(points).astype(np.float32) for points in small]
    skeleton = make_skeleton({str(i): loop for i, loop in enumerate(obstacles)})
    for remove_empty in (True, False):
        found = jitted(state, skeleton, remove_empty=remove_empty)
        assert found.touching or found.vectors == literal_algorithm(state, obstacles, remove_empty)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_loops_as_polylines_have_the_numbers_and_margins_of_the_signature(seed):
    rng = np.random.default_rng(seed)
    state = random_state(rng)
    obstacles = [curves.closed(rng.normal(size=(points, 3))) for points in (5, 4)]
    skeleton = make_skeleton({str(place): loop for place, loop in enumerate(obstacles)})
    found, loops = jitted(state, skeleton, remove_empty=False), polylines(state)
    active = np.asarray(loops.active)
    assert int(found.count) == active.sum()
    paths = np.asarray(loops.points)[active]
    np.testing.assert_array_equal(paths[:, 0], paths[:, -1])
    number = np.abs(all_pairs(loops.points, skeleton.loops).number)[active]
    if not found.touching:
        assert found.vectors == tuple(sorted(map(tuple, number.tolist()), reverse=True))
    margins = [oracle_margin(path, loop) for path in paths for loop in obstacles]
    size = float(np.ptp(np.concatenate([paths.reshape(-1, 3), *obstacles, state.rope]), axis=0).max())
    if margins:
        assert float(found.margin) == pytest.approx(min(margins), abs=4e-6 * size)
    else:
        assert found.margin == np.inf


def test_a_batch_equals_its_elements_and_compiles_once():
    rng = np.random.default_rng(1)
    states = [random_state(rng) for _ in range(16)]
    skeleton = make_skeleton({"one": curves.closed(rng.normal(size=(6, 3)))})
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    counted = eqx.debug.assert_max_traces(max_traces=1)(signature)
    run = jax.jit(jax.vmap(counted, (0, None)))
    first, second = run(batch, skeleton), run(jax.tree.map(lambda x: x[::-1], batch), skeleton)
    for place, state in enumerate(states):
        alone = jitted(state, skeleton)
        assert alone == jax.tree.map(lambda x, place=place: x[place], first)
        assert alone == jax.tree.map(lambda x, place=place: x[-1 - place], second)


def test_a_skeleton_loop_that_is_not_active_is_never_passed_through():
    far = SKELETON.loops.at[1].add(1e9)  # parked
    skeleton = eqx.tree_at(lambda s: (s.loops, s.active), SKELETON, (far, jnp.array([True, False])))
    found = jitted(straight_arms(0.9), skeleton)
    assert str(found) == "{(1,0)}" and not found.touching
    assert float(found.margin) == pytest.approx(0.2, abs=1e-4)


def test_one_holder_alone_has_no_loop():
    alone = make_grasps(ROPE, BASE, {"only": Holder(0.5)})
    assert str(jitted(alone, SKELETON)) == "∅"
    assert polylines(alone).points.shape[0] == 0


# Bad input


def test_touching_and_malformed_states_are_reported_under_jit():
    through_wire = make_skeleton(
        {"A": rectangle([0.5, 1, 0.2], [0, 0.2, 0], [0, 0, 0.2])}
    )  # the rope meets a side
    found = jitted(straight_arms(0.9), through_wire)
    assert found.touching and found.margin < 1e-5
    assert str(found).endswith(" touching"), "who prints it is told"
    for place, broken in [
        (lambda g: g.gripper_locations, jnp.array([1.2, 0.0])),
        (lambda g: g.gripper_locations, jnp.array([-0.1, 0.0])),
        (lambda g: g.rope, jnp.asarray(ROPE).at[3, 1].set(jnp.nan)),
        (lambda g: g.base, jnp.array([jnp.inf, 0, 0])),
    ]:
        found = jitted(eqx.tree_at(place, straight_arms(0.9), broken), SKELETON)
        assert found.touching and np.isnan(found.margin)
    opened = eqx.tree_at(lambda s: s.loops, SKELETON, SKELETON.loops.at[0, 0, 0].add(0.1))
    found = jitted(straight_arms(0.9), opened)
    assert found.touching and np.isnan(found.margin)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"grippers": {"left": Holder(1.2)}}, "the location of gripper 'left' is 1.2; expected 0 to 1"),
        ({"attachments": {"plug": Holder(-0.1)}}, "the location of attachment 'plug' is -0.1"),
        ({"attachments": {"plug": Holder(np.nan)}}, "the location of attachment 'plug' is nan"),
        ({"grippers": {"left": Holder("end")}}, "the location of gripper 'left' is 'end'"),
        ({"max_grippers": 1}, r"2 grippers \(left, right\) are given; there is room for 1"),
        ({"max_attachments": 0}, r"1 attachments \(wall\) are given; there is room for 0"),
        ({"rope": ROPE[:1]}, "the rope has 1 points; expected at least two"),
        ({"rope": ROPE[:, :2]}, r"the rope has shape \(11, 2\)"),
        ({"rope": np.where(np.arange(11)[:, None] == 4, np.nan, ROPE)}, "the rope is not finite at point 4"),
        ({"rope": np.repeat(ROPE, 2, axis=0)}, "the rope has a link without length at point 0"),
        ({"base": [0, 0]}, r"the base has shape \(1, 2\)"),
        (
            {"grippers": {"left": Holder(0.5, [[0, np.inf, 0]])}},
            "the path of gripper 'left' is not finite at point 0",
        ),
        (
            {"grippers": {"left": Holder(0.5, [[0, 0, 0], [1]])}},
            "the path of gripper 'left' is no list of points",
        ),
    ],
)
def test_bad_descriptions_are_errors_that_name_the_item(arguments, message):
    sound = {
        "rope": ROPE,
        "base": BASE,
        "grippers": {"left": Holder(0.2), "right": Holder(0.8)},
        "attachments": {"wall": Holder(0.0, BELOW)},
    }
    make_grasps(**sound)
    with pytest.raises(ValueError, match=message):
        make_grasps(**(sound | arguments))
