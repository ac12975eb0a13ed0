"""Boxes cover a mesh, stick out of it by no more than allowed, and are few where boxes are all there is."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.geometry.mesh_boxes import covering_boxes, cut_off
from doojax.geometry.mesh_parts import winding

WITHIN = 0.02


def inside(boxes, points):
    """Is each point in some box?"""
    return ((points[:, None] >= boxes[:, 0]) & (points[:, None] <= boxes[:, 1])).all(-1).any(-1)


def points_of(boxes, random, count=4000):
    """Points anywhere in boxes, their corners among them."""
    chosen = random.integers(0, len(boxes), count)
    fractions = np.clip(random.uniform(-0.2, 1.2, (count, 3)), 0, 1)
    return boxes[chosen, 0] + fractions * (boxes[chosen, 1] - boxes[chosen, 0])


def slab(size, middle):
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(middle))


def test_what_is_made_of_boxes_comes_out_as_those_boxes():
    """A foot and a post on it as one solid: two boxes, but for a thousandth of what is allowed."""
    outline = np.array([[0, 0], [0.3, 0], [0.3, 0.05], [0.04, 0.05], [0.04, 0.2], [0, 0.2]])
    triangles = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    bracket = trimesh.creation.extrude_triangulation(outline, np.array(triangles), 0.1)
    boxes = covering_boxes(bracket, WITHIN)
    assert len(boxes) == 2
    volume = (boxes[:, 1] - boxes[:, 0]).prod(1).sum()
    assert volume == pytest.approx(0.3 * 0.05 * 0.1 + 0.04 * 0.15 * 0.1, rel=5e-3)
    (one,) = covering_boxes(trimesh.creation.box((0.1, 0.2, 0.3)), WITHIN)
    np.testing.assert_allclose(one, [[-0.05, -0.1, -0.15], [0.05, 0.1, 0.15]], atol=1.1e-3 * WITHIN)


@pytest.mark.parametrize(("within", "most"), [(0.05, 47), (0.03, 150)])
def test_a_ball_is_covered_as_closely_as_asked(within, most):
    ball = trimesh.creation.icosphere(2, radius=0.1)  # whose faces lie within the ball
    boxes = covering_boxes(ball, within)
    assert 1 < len(boxes) <= most
    random = np.random.default_rng(0)
    assert inside(boxes, np.append(ball.vertices, [[0, 0, 0]], 0)).all()
    out = np.linalg.norm(points_of(boxes, random), axis=1) - 0.1
    assert 0.2 * within < out.max() <= within


def test_a_ring_keeps_its_hole_and_a_hollow_box_its_hollow():
    ring = trimesh.creation.torus(0.1, 0.03, major_sections=16, minor_sections=8)
    boxes = covering_boxes(ring, 0.03)
    assert not inside(boxes, np.zeros((1, 3))).any()
    assert inside(boxes, ring.vertices).all()
    shell = trimesh.creation.box((0.2, 0.2, 0.2))
    hollow = trimesh.creation.box((0.16, 0.16, 0.16))
    hollow.invert()
    boxes = covering_boxes(trimesh.util.concatenate([shell, hollow]), WITHIN)
    assert not inside(boxes, np.zeros((1, 3))).any()
    assert inside(boxes, np.array([[0.09, 0, 0], [0, -0.09, 0.05], [0.1, 0.1, 0.1]])).all()


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**31))
def test_any_heap_of_boxes_and_hulls_is_covered_and_no_box_sticks_out(seed):
    """Random parts that overlap or do not, turned any way; a heap is as near as its nearest part."""
    random = np.random.default_rng(seed)
    parts = []
    for _ in range(random.integers(1, 4)):
        turn = trimesh.transformations.random_rotation_matrix(random.uniform(size=3))
        turn[:3, 3] = random.uniform(-0.1, 0.1, 3)
        points = random.uniform(-1, 1, (12, 3)) * random.uniform(0.02, 0.1, 3)
        parts.append(trimesh.convex.convex_hull(points).apply_transform(turn))
    boxes = covering_boxes(trimesh.util.concatenate(parts), 0.03)
    for part in parts:
        assert inside(boxes, np.asarray(part.vertices)).all()
        assert inside(boxes, part.triangles_center).all()
        shares = random.dirichlet(np.ones(len(part.vertices)), 200)
        assert inside(boxes, shares @ part.vertices).all()
    # a point that is farther than allowed from every part's planes is out of every part by more than that
    points = points_of(boxes, random, 1000)
    beyond = [
        ((points[:, None] - part.triangles_center) * part.face_normals).sum(-1).max(1) for part in parts
    ]
    assert np.min(beyond, axis=0).max() <= 0.03


def test_a_cut_surface_encloses_what_is_left_with_the_plane(size=0.2):
    """The flux of a constant field through what is left is that through the cut: the area cut through."""
    ball = trimesh.creation.icosphere(3, radius=size)
    for cut in (-0.1, 0.0, 0.05):
        left = cut_off(np.asarray(ball.triangles), 2, cut, upper=True)
        assert (left[..., 2] >= cut).all()
        edges = left[:, 1:] - left[:, :1]
        flux = np.cross(edges[:, 0], edges[:, 1])[:, 2].sum() / 2
        assert flux == pytest.approx(np.pi * (size**2 - cut**2), rel=0.02)
        rest = cut_off(np.asarray(ball.triangles), 2, cut, upper=False)
        total = sum(
            np.linalg.norm(np.cross(*np.moveaxis(p[:, 1:] - p[:, :1], 1, 0)), axis=1).sum() / 2
            for p in (left, rest)
        )
        assert total == pytest.approx(ball.area, rel=1e-9)


def test_a_plane_through_faces_leaves_them_to_the_side_where_the_solid_is():
    cube = np.asarray(slab((0.2, 0.2, 0.2), (0.0, 0.0, 0.1)).triangles)
    assert len(cut_off(cube, 2, 0.0, upper=False)) == 0
    assert len(cut_off(cube, 2, 0.0, upper=True)) == len(cube)
    assert winding(np.array([[0.0, 0.0, 0.1]]), cut_off(cube, 2, 0.0, upper=True)) == pytest.approx(1)


@pytest.mark.parametrize(
    ("mesh", "within", "most", "message"),
    [
        (trimesh.creation.box((1, 1, 1)), 0.0, 9, "within is 0.0, expected"),
        (trimesh.creation.box((400, 1, 1)), 1.0, 9, "at least 2 m"),
        (trimesh.creation.icosphere(2, radius=0.1), 0.01, 9, "more than 9 boxes are needed"),
        (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), 0.1, 9, "not watertight"),
    ],
)
def test_what_cannot_be_covered_is_refused_with_advice(mesh, within, most, message):
    with pytest.raises(ValueError, match=message):
        covering_boxes(mesh, within, most)
