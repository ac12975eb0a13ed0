"""Neighbour lists against all pairs."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.geometry.box import Box
from doojax.simulation.fluid.neighbours import find_neighbours, in_order, rows_of

REACH, REGION = 0.1, Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
COUNT = 200


@partial(jax.jit, static_argnums=(1, 2))
def found(positions, capacity, region=REGION):
    order, keys, cells = in_order(positions, REACH, region)
    placed = positions[order]
    return order, find_neighbours(placed, keys, cells, REACH, region, capacity)


def pairs(positions, capacity=32, region=REGION):
    """The set of pairs by the lists, by the particles' own numbers; and were any dropped?"""
    order, lists = jax.tree.map(np.asarray, found(jnp.asarray(positions, jnp.float32), capacity, region))
    columns = np.broadcast_to(np.arange(len(order)), lists.index.shape)
    both = zip(order[columns[lists.there]], order[lists.index[lists.there]], strict=True)
    here = {(int(i), int(j)) for i, j in both}
    assert len(here) == lists.there.sum()  # nobody is named twice
    return here, bool(lists.dropped)


def all_pairs(positions):
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    return {(int(i), int(j)) for i, j in zip(*np.nonzero(gaps < REACH), strict=True)}


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("spread", [0.25, 0.9, 1.6])  # crowded, loose, partly outside of the region
def test_the_lists_hold_all_pairs_within_reach_and_no_others(dimensions, spread):
    if dimensions == 2:
        spread = max(spread, 0.6)
    rng = np.random.default_rng(int(10 * spread) + dimensions)
    positions = rng.uniform(-spread, spread, (COUNT, dimensions)).astype(np.float32)
    here, dropped = pairs(positions)
    assert not dropped
    assert here == all_pairs(positions)


def test_particles_on_the_edges_of_rows_are_found():
    axis = np.arange(-3, 4, dtype=np.float32) * np.float32(0.55 * REACH)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    here, dropped = pairs(grid[:COUNT])
    expected = all_pairs(grid[:COUNT])
    assert not dropped
    assert here == expected


def test_a_crowd_in_a_corner_of_rows_is_found():
    """A block whose first particles stand 1 mm from the edges of their rows: of a row that meets theirs in
    an edge alone, two by two lines of five particles are in reach."""
    axis = 0.001 + np.arange(-3, 3, dtype=np.float32) * np.float32(0.495 * REACH)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    here, dropped = pairs(grid, capacity=40)
    assert not dropped
    assert here == all_pairs(grid)


def test_a_large_region_finds_the_same_pairs():
    """Of 201 by 201 rows x is cut into fewer parts."""
    positions = np.random.default_rng(2).uniform(-0.3, 0.3, (COUNT, 3)).astype(np.float32)
    here, dropped = pairs(positions, region=Box((-10.0, -10.0, -10.0), (10.0, 10.0, 10.0)))
    assert not dropped
    assert here == all_pairs(positions)


def test_what_there_is_no_room_for_is_told():
    crowd = np.random.default_rng(0).uniform(-0.02, 0.02, (COUNT, 3))
    _, dropped = pairs(crowd)
    assert dropped


def test_values_that_are_no_numbers_are_nobodys_neighbours():
    positions = np.random.default_rng(1).uniform(-0.5, 0.5, (COUNT, 3)).astype(np.float32)
    positions[7] = np.nan
    here, _ = pairs(positions)
    assert not any(7 in pair for pair in here)


def test_a_region_too_large_to_sort_is_refused():
    with pytest.raises(ValueError, match=r"too large for a reach of 0\.001 m: expected at most"):
        rows_of(REGION, 0.001, 3)
