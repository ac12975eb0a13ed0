"""Skeletons by hand and from solids: every handle once, closed, inside, and linked like the handle itself."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from doojax.topology import linking_number, make_skeleton, mesh_skeleton, obstacle_skeleton, rectangle
from doojax.topology.thinning import handle_loops, thin
from doojax.types import Obstacles, ShapeKind

from . import curves


def boxes(centres, half_sizes):
    count = len(centres)
    return Obstacles(
        kind=jnp.full(count, int(ShapeKind.BOX)),
        centre=jnp.array(centres, float),
        quaternion=jnp.tile(jnp.array([1.0, 0, 0, 0]), (count, 1)),
        half_size=jnp.array(half_sizes, float),
        active=jnp.ones(count, bool),
    )


def numbers(skeleton, probes):
    return [
        [abs(linking_number(probe, unpadded(loop))) for probe in probes]
        for loop in np.asarray(skeleton.loops)
    ]


def unpadded(loop):
    return loop[np.append(True, (loop[1:] != loop[:-1]).any(axis=1))]


# By hand


def test_loops_by_hand_are_kept_padded_and_named():
    triangle = curves.closed(np.eye(3))
    skeleton = make_skeleton({"ring": curves.circle(count=8), "triangle": triangle})
    assert skeleton.names == ("ring", "triangle")
    assert skeleton.loops.shape == (2, 9, 3) and skeleton.active.all()
    np.testing.assert_allclose(skeleton.loops[1, :4], triangle)
    assert (skeleton.loops[:, 0] == skeleton.loops[:, -1]).all()
    assert make_skeleton({}).loops.shape[0] == 0


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.eye(3), r"skeleton loop 'shelf' has 3 points"),
        (np.vstack([np.eye(3), np.ones(3)]), r"skeleton loop 'shelf' is open"),
        (curves.closed(np.vstack([np.eye(3), np.full(3, np.nan)])), r"'shelf' is not finite at point 3"),
        (curves.closed(np.eye(3)[[0, 1, 1, 2]]), r"'shelf' has a segment without length at point 1"),
    ],
)
def test_a_loop_that_is_none_is_an_error_with_its_name(points, message):
    with pytest.raises(ValueError, match=message):
        make_skeleton({"sound": curves.circle(), "shelf": points})


def test_a_rectangle_turns_from_its_first_vector_to_its_second():
    loop = rectangle([1, 2, 3], [0.5, 0, 0], [0, 0, 0.2])
    np.testing.assert_allclose(loop.mean(axis=0)[1], 2)
    np.testing.assert_allclose(np.ptp(loop, axis=0), [1, 0, 0.4])
    along = curves.closed([[1, 1, 3], [1, 3, 3], [9, 3, 3], [9, 1, 3]])  # along +y through it
    assert linking_number(along, loop) == -1  # x cross z is -y
    with pytest.raises(ValueError, match="expected three vectors"):
        rectangle([1, 2, 3], [1, 2], [0, 0, 1])


# Voxels


def betti_numbers(solid):
    """Parts, handles and cavities of a union of closed cubes, from its Euler characteristic."""
    padded = np.pad(solid, 1)
    euler = 0
    for extent in itertools.product([0, 1], repeat=3):  # cells of the complex that extend along these axes
        cells = np.zeros([n + 1 - e for n, e in zip(padded.shape, extent, strict=True)], bool)
        for shift in itertools.product(*[[0] if e else [0, 1] for e in extent]):
            cells[tuple(slice(s, s + n) for s, n in zip(shift, padded.shape, strict=True))] |= padded
        euler += (-1) ** sum(extent) * cells.sum()
    parts = ndimage.label(padded, np.ones((3, 3, 3)))[1]
    cavities = ndimage.label(~padded)[1] - 1
    return parts, parts + cavities - euler, cavities


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), density=st.floats(0.05, 0.5))
def test_random_solids_keep_their_topology_when_thinned_and_give_one_loop_per_handle(seed, density):
    solid = ndimage.binary_fill_holes(np.random.default_rng(seed).random((7, 7, 7)) < density)
    thinned = thin(solid)
    assert betti_numbers(thinned) == betti_numbers(solid)
    assert not (thinned & ~solid).any()
    loops = handle_loops(solid)
    assert len(loops) == betti_numbers(solid)[1]
    for loop in loops:
        assert thinned[tuple(loop.T)].all()
        assert len(np.unique(loop, axis=0)) == len(loop) >= 4
        steps = np.diff(np.concatenate([loop, loop[:1]]), axis=0)
        assert np.abs(steps).max() == 1


def test_thinning_leaves_no_loose_ends_and_a_point_of_what_has_no_handle():
    ball = np.sum(np.mgrid[-6:7, -6:7, -6:7] ** 2, axis=0) < 30
    assert thin(ball).sum() == 1
    ring = np.zeros((12, 12, 5), bool)
    ring[1:11, 1:11, 1:4] = True
    ring[4:8, 4:8] = False
    ring[6, 0] = True  # a thorn
    left = np.argwhere(thin(ring))
    for voxel in left:
        assert np.sum(np.abs(left - voxel).max(axis=1) == 1) == 2
    hollow = np.pad(np.zeros((3, 3, 3), bool), 2, constant_values=True)
    assert thin(hollow).sum() == 1 and handle_loops(hollow) == []


# Solids


def test_a_frame_of_four_boxes_is_one_loop_through_its_bars():
    centres = [[0, 0, 0.2], [0, 0, -0.2], [0.2, 0, 0], [-0.2, 0, 0]]
    half_sizes = [[0.225, 0.025, 0.025]] * 2 + [[0.025, 0.025, 0.225]] * 2
    skeleton = obstacle_skeleton(boxes(centres, half_sizes), resolution=0.02)
    assert skeleton.names == ("handle0",)
    through, beside = (curves.circle(0.4, (x, 0, 0), axes=(0, 1)) for x in (0.4, 0.9))
    around_all = curves.circle(1.0, axes=(0, 1))
    assert numbers(skeleton, [through, beside, around_all]) == [[1, 0, 0]]
    corners = unpadded(np.asarray(skeleton.loops[0]))
    assert len(corners) < 10, "straight bars need no more points"
    assert np.abs(corners[:, 1]).max() < 0.03 and np.abs(corners[:, [0, 2]]).max() < 0.24


def test_three_fixtures_on_a_wall_are_three_loops():
    # As in threading: each fixture is three bars, and the wall closes it.
    centres, half_sizes, middles = [[0, 0.7, 0.4]], [[0.6, 0.05, 0.3]], [(0.3, 0.3), (0, 0.5), (-0.3, 0.4)]
    for x, z in middles:
        centres += [[x, 0.56, z - 0.06], [x, 0.56, z + 0.06], [x, 0.49, z]]
        half_sizes += [[0.01, 0.1, 0.01], [0.01, 0.1, 0.01], [0.01, 0.01, 0.07]]
    skeleton = obstacle_skeleton(boxes(centres, half_sizes), resolution=0.02)
    probes = [curves.circle(0.2, (x, 0.57, z + 0.2), axes=(0, 2)) for x, z in middles]
    found = np.array(numbers(skeleton, probes))
    assert sorted(found.tolist()) == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]


def test_a_rack_of_three_shelves_and_eight_posts_has_six_handles():
    centres = [[0, 0.76, z] for z in (-0.415, 0.085, 0.535)]
    half_sizes = [[0.42, 0.29, 0.03]] * 3
    for x, y, z in itertools.product((0.38, -0.38), (0.51, 1.01), (-0.165, 0.31)):
        centres.append([x, y, z])
        half_sizes.append([0.04, 0.04, 0.25])
    skeleton = obstacle_skeleton(boxes(centres, half_sizes), resolution=0.04)
    assert len(skeleton.names) == 6


def test_rotated_capsules_and_parked_obstacles():
    # A triangle of three capsules in the xz plane; a parked box far below does not widen the grid.
    angles = np.deg2rad([0, 120, 240])
    turns = angles / 2  # about y, from z
    obstacles = Obstacles(
        kind=jnp.array([1, 1, 1, 0]),
        centre=jnp.array([*[[0.3 * np.cos(a), 0, -0.3 * np.sin(a)] for a in angles], [0, 0, -1e4]]),
        quaternion=jnp.array([*[[np.cos(t), 0, np.sin(t), 0] for t in turns], [1.0, 0, 0, 0]]),
        half_size=jnp.array([[0.03, 0.03, 0.52]] * 3 + [[1.0, 1, 1]]),
        active=jnp.array([True, True, True, False]),
    )
    skeleton = obstacle_skeleton(obstacles, resolution=0.03)
    assert numbers(skeleton, [curves.circle(0.6, (0.6, 0, 0), axes=(0, 1))]) == [[1]]


def test_meshes_of_known_genus():
    trimesh = pytest.importorskip("trimesh")
    torus = trimesh.creation.torus(0.3, 0.08)
    skeleton = mesh_skeleton(torus, resolution=0.04)
    axis = curves.closed([[0, 0, -1], [0, 0, 1], [2, 0, 1], [2, 0, -1]])
    assert numbers(skeleton, [axis]) == [[1]]
    distance_from_middle = np.linalg.norm(np.asarray(skeleton.loops[0])[:, :2], axis=1)
    assert distance_from_middle.min() > 0.18
    assert len(mesh_skeleton(trimesh.creation.icosphere(radius=0.2), resolution=0.05).names) == 0


def test_what_has_no_skeleton_is_an_error():
    box = boxes([[0, 0, 0]], [[0.1, 0.1, 0.1]])
    assert obstacle_skeleton(box, resolution=0.05).names == ()
    parked = Obstacles(box.kind, box.centre, box.quaternion, box.half_size, jnp.zeros(1, bool))
    with pytest.raises(ValueError, match="no obstacle is active"):
        obstacle_skeleton(parked, resolution=0.05)
    with pytest.raises(ValueError, match=r"voxels is beyond 5000000: increase resolution \(0.001 m\)"):
        obstacle_skeleton(box, resolution=0.001)
    with pytest.raises(ValueError, match="resolution is 0"):
        obstacle_skeleton(box, resolution=0.0)
