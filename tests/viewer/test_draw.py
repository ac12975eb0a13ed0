"""A drawing on a viser scene, seen from the server: what its handles say."""

import numpy as np
import pytest

from doojax.viewer import colours
from doojax.viewer.draw import SceneDrawing
from doojax.viewer.episodes import rotation_matrices
from doojax.viewer.page import start_server
from doojax.viewer.shapes import smooth

RADIUS = 0.01
POINTS = np.array(
    [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.17, 0.07, 0.0], [0.17, 0.07, -0.1], [0.17, 0.07, -0.2]]
)


@pytest.fixture(scope="module")
def scene():
    """An empty one."""
    server = start_server("127.0.0.1", 0)
    yield server.scene
    server.stop()


def pieces(drawing, name):
    """The handles of what is drawn in pieces."""
    return drawing._handles[name]._meshes


def test_a_ropes_pieces_lie_along_its_curve_wherever_it_moves(scene):
    drawing = SceneDrawing(scene, "/along")
    for shift in (0.0, 0.3):
        drawing.rope("rope", POINTS + shift, radius=RADIUS, colour=colours.ROPE)
        curve = smooth(POINTS + shift)
        steps = np.diff(curve, axis=0)
        found = pieces(drawing, "rope")
        assert len(found) == len(curve) - 1
        axes = rotation_matrices(np.array([piece.wxyz for piece in found]))[:, :, 2]
        np.testing.assert_allclose(
            axes, steps / np.linalg.norm(steps, axis=1, keepdims=True), atol=1e-6
        )  # the last are straight down, where the shortest turn of z has no one axis
        np.testing.assert_allclose(
            [piece.position for piece in found], (curve[1:] + curve[:-1]) / 2, atol=1e-6
        )


def test_pieces_move_and_are_made_anew_only_for_a_rope_of_other_length_or_look(scene):
    drawing = SceneDrawing(scene, "/anew")

    def drawn(points, **look):
        drawing.rope("rope", points, **{"radius": RADIUS, "colour": colours.ROPE} | look)
        return drawing._handles["rope"]

    first = drawn(POINTS)
    assert drawn(POINTS[::-1]) is first and drawn(1.05 * POINTS) is first
    longer = drawn(1.3 * POINTS)  # pieces of 33 mm; round ends of 10 mm would not reach
    reach = np.abs(pieces(drawing, "rope")[0].vertices[:, 2]).max()
    lengths = np.linalg.norm(np.diff(smooth(1.3 * POINTS), axis=0), axis=1)
    assert longer is not first and reach == pytest.approx(lengths.mean() / 2 + RADIUS, rel=1e-5)
    assert drawn(1.3 * POINTS, colour=colours.CHOSEN) is not longer
    drawing.rope("rope", POINTS * np.nan, radius=RADIUS, colour=colours.ROPE)
    assert "rope" not in drawing._handles
    assert drawn(POINTS) is drawing._handles["rope"]


def test_few_spheres_are_where_they_are_put_in_their_own_colours(scene):
    drawing = SceneDrawing(scene, "/few")
    each = np.array([[255, 0, 0], [0, 0, 255]], dtype=np.uint8)
    centres = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], dtype=np.float32)
    for shift in (0, 1):
        drawing.spheres("hands", centres + shift, radius=0.02, colours=each)
        found = pieces(drawing, "hands")
        np.testing.assert_allclose([ball.position for ball in found], centres + shift)
        assert [tuple(ball.color) for ball in found] == [(255, 0, 0), (0, 0, 255)]
    first = drawing._handles["hands"]
    drawing.spheres("hands", centres, radius=0.02, colours=each[::-1])  # painted, not made anew: no flicker
    assert drawing._handles["hands"] is first
    assert [tuple(ball.color) for ball in found] == [(0, 0, 255), (255, 0, 0)]
    drawing.spheres("hands", centres[:1], radius=0.02, colours=each[:1])
    assert len(pieces(drawing, "hands")) == 1
