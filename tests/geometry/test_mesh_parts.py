"""Meshes as people have them: thin faces, parts in parts, split vertices; and advice that mends them."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from doojax.geometry import fill_mesh_grid, mesh_signed_distance
from doojax.geometry.mesh_parts import solid_parts

from .test_mesh_grid import box_distance, nodes


def box(extents, at=(0.0, 0.0, 0.0), inward=False):
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(at)
    if inward:
        mesh.invert()
    return mesh


def together(*meshes):
    return trimesh.util.concatenate(list(meshes))


def split(mesh):
    """Every face with corners of its own, as exporters write them."""
    return trimesh.Trimesh(
        mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False
    )


def values_and_points(*meshes, spacing=0.05, padding=0.05):
    grid = fill_mesh_grid(together(*meshes), spacing, padding)
    return np.asarray(grid.values), nodes(grid)


@pytest.mark.parametrize("width", [0.0, 1e-12, 6e-8])
def test_a_face_with_no_width_to_speak_of_changes_nothing(width):
    # An edge of the box is cut in two, and the new corner joined to the old edge's ends by a needle.
    half = np.array([0.55, 0.4, 0.6])
    mesh = trimesh.creation.box(2 * half)
    a, b = 0, next(int(end) for edge in mesh.edges_unique for end in edge[edge != 0] if 0 in edge)
    vertices = np.vstack([mesh.vertices, mesh.vertices[a] * 0.7 + mesh.vertices[b] * 0.3])
    vertices[-1] -= width * np.sign(vertices[-1])
    faces = mesh.faces.tolist()
    turned = next(face for face in faces if {a, b} <= set(face))
    faces.remove(turned)
    third = next(corner for corner in turned if corner not in (a, b))
    if turned[(turned.index(a) + 1) % 3] != b:
        a, b = b, a
    faces += [[a, 8, third], [8, b, third], [a, b, 8]]
    needle = trimesh.Trimesh(vertices, faces, process=False)
    assert needle.is_watertight and needle.is_winding_consistent and len(needle.faces) == 14
    grid = fill_mesh_grid(needle, 0.11, 0.1)
    np.testing.assert_allclose(grid.values, box_distance(nodes(grid), half), atol=2e-6)


def test_parts_that_overlap_count_by_the_one_entered_deepest_whichever_way_they_are_wound():
    post, shelf = (0.04, 0.04, 0.4), (0.3, 0.3, 0.04)
    for inward in (False, True):
        found, points = values_and_points(box(post), box(shelf, (0, 0, 0.1), inward), spacing=0.02)
        closed_form = np.minimum(
            box_distance(points, np.array(post) / 2),
            box_distance(points - [0, 0, 0.1], np.array(shelf) / 2),
        )
        np.testing.assert_allclose(found, closed_form, atol=1e-6)
    mesh = together(box(post), box(shelf, (0, 0, 0.1), True))
    middle = mesh_signed_distance(fill_mesh_grid(mesh, 0.02, 0.1), jnp.array([0.0, 0.0, 0.1]))
    assert middle == pytest.approx(-0.02, abs=1e-6)


def test_faces_of_a_part_hidden_in_another_do_not_make_it_shallow():
    found, points = values_and_points(box((0.4, 0.4, 0.4)), box((0.1, 0.1, 0.1)))
    np.testing.assert_allclose(found, box_distance(points, np.full(3, 0.2)), atol=1e-6)


@pytest.mark.parametrize("inward", [False, True])
def test_a_part_in_another_wound_the_other_way_is_a_cavity_and_one_in_the_cavity_is_solid(inward):
    found, points = values_and_points(
        box((0.6, 0.6, 0.6), inward=inward),
        box((0.4, 0.4, 0.4), inward=not inward),
        box((0.2, 0.2, 0.2), inward=inward),
    )
    outer, cavity, inner = (box_distance(points, np.full(3, half)) for half in (0.3, 0.2, 0.1))
    np.testing.assert_allclose(found, np.minimum(np.maximum(outer, -cavity), inner), atol=1e-6)
    assert [len(part) for part in solid_parts(together(box((2, 2, 2)), box((1, 1, 1), inward=True)))] == [24]


def advice(mesh):
    """What an error says mends the mesh, done."""
    with pytest.raises(ValueError) as caught:
        fill_mesh_grid(mesh, 0.05, 0.05)
    mended = mesh.copy()
    call = r"(?:mesh|trimesh)\.\w+(?:\.\w+)?\((?:[^()]|\([^()]*\))*\)"
    calls = re.findall(call, str(caught.value).split(";")[-1])
    assert calls, caught.value
    for call in calls:
        exec(call, {"mesh": mended, "trimesh": trimesh})
    return mended, str(caught.value)


def filled(mesh):
    trimesh.repair.fill_holes(mesh)
    return mesh


def holed(mesh):
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    return mesh


def turned(mesh):
    mesh.faces[0] = mesh.faces[0][::-1]
    return mesh


def doubled(mesh):
    return trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, mesh.faces[:3, ::-1]]), process=False)


@pytest.mark.parametrize(
    ("make", "complaint", "remedy"),
    [
        (split, "not watertight: 60 of its 60 edges", "merge_vertices"),
        (lambda mesh: filled(split(mesh)), "40 of the mesh's 40 faces lie back to back", "unique_faces"),
        (doubled, "6 of the mesh's 23 faces lie back to back", "unique_faces"),
        (turned, "wound inconsistently", "fix_winding"),
        (lambda mesh: split(turned(mesh)), "not watertight", "fix_winding"),
        (holed, "3 of its 30 edges do not join two faces", "fill_holes"),
        (lambda mesh: split(holed(mesh)), "not watertight", "merge_vertices"),
    ],
)
def test_advice_mends_the_mesh(make, complaint, remedy):
    ball = trimesh.creation.icosahedron()
    ball.apply_scale(0.1)
    whole = ball.copy()
    mended, message = advice(make(ball))
    assert complaint in message and remedy in message
    np.testing.assert_allclose(
        fill_mesh_grid(mended, 0.05, 0.05).values, fill_mesh_grid(whole, 0.05, 0.05).values, atol=1e-6
    )


def test_what_nothing_mends_is_not_sent_in_circles():
    half = trimesh.creation.icosphere(subdivisions=2)
    half.update_faces(half.triangles_center[:, 2] > 0)
    with pytest.raises(
        ValueError, match=r"neither merging vertices, .* mends it: close it where it was made"
    ):
        fill_mesh_grid(half, 0.5, 0.5)


def test_a_scene_is_refused_and_its_mesh_is_what_it_shows():
    scene, up = trimesh.Scene(), trimesh.transformations.translation_matrix([0, 0, 0.5])
    scene.add_geometry(box((0.2, 0.2, 0.2)), transform=up)
    with pytest.raises(ValueError, match=r"got a trimesh.Scene: .* scene\.to_mesh\(\)"):
        fill_mesh_grid(scene, 0.05, 0.05)
    found, points = values_and_points(scene.to_mesh())
    np.testing.assert_allclose(found, box_distance(points - [0, 0, 0.5], np.full(3, 0.1)), atol=1e-6)


def test_what_is_no_mesh_is_refused():
    with pytest.raises(ValueError, match=r"expected a trimesh.Trimesh, got a PointCloud"):
        fill_mesh_grid(trimesh.PointCloud(np.eye(3)), 0.1, 0.1)
    with pytest.raises(ValueError, match="the mesh has no faces"):
        fill_mesh_grid(trimesh.Trimesh(), 0.1, 0.1)
    broken = box((1, 1, 1))
    broken.vertices[3, 1] = np.nan
    with pytest.raises(ValueError, match="vertex 3 is not finite"):
        fill_mesh_grid(broken, 0.1, 0.1)
