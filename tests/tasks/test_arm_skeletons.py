"""Skeletons by hand are those of the boxes: each loop of one is a sum of loops of the other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.keys import generator
from doojax.simulation.scenes import obstacles_at
from doojax.tasks.arms import BASE
from doojax.tasks.threading import FIXTURES, TURNED, threading
from doojax.tasks.untangling import BACK, FRONT, LEVELS, untangling
from doojax.topology import linking_of, make_skeleton, obstacle_skeleton

linked = jax.jit(jax.vmap(jax.vmap(linking_of, (None, 0)), (0, None)))


def numbers(curves, skeleton):
    """Linking numbers of closed curves (one shape) with loops, [C, S]."""
    found = linked(jnp.asarray(np.array(curves), jnp.float32), skeleton.loops)
    assert not np.asarray(found.touching).any()
    return np.asarray(found.number)


def is_sum(parts: np.ndarray, whole: np.ndarray) -> bool:
    """Is each column of ``whole`` a sum of columns of ``parts``, whole numbers of each, for all curves?"""
    weights = np.rint(np.linalg.lstsq(parts.astype(float), whole.astype(float), rcond=None)[0])
    return bool((parts @ weights == whole).all())


def skeletons(task, chosen, resolution):
    """Of one drawn scene: by hand, and of those boxes that are chosen by name."""
    drawn = task.draw(task, generator(0, "test", "skeleton", task.name))
    hand = make_skeleton(task.loops(drawn.centres))
    scene = task.scene
    position = jnp.array([drawn.centres[one.name] for one in scene.obstacles])
    yaws = jnp.array([drawn.yaws.get(one.name, 0.0) for one in scene.obstacles])
    zero = jnp.zeros_like(yaws)
    turned = jnp.stack([jnp.cos(yaws / 2), zero, zero, jnp.sin(yaws / 2)], -1)
    far = jnp.array([[0.0, 0, -10]])  # what is not chosen is parked
    wanted = jnp.array([chosen(one.name) for one in scene.obstacles])
    boxes = obstacles_at(scene, jnp.where(wanted[:, None], position, far), turned)
    return drawn, hand, obstacle_skeleton(boxes, resolution)


def rack_curves(drawn):
    """Out of each storey of the rack by the right face, and in by each of the others."""
    middle_y, found = (FRONT + BACK) / 2, []
    ring = [(1.5, middle_y), (1.5, 2.2), (0, 2.2), (-1.5, 2.2), (-1.5, middle_y), (-1.5, -0.7), (0, -0.7)]
    for low, high in LEVELS.values():
        z = (low + high) / 2 + BASE[2]
        for last in (2, 4, 6):  # back, left, front
            around = [*ring[: last + 1], *[ring[last]] * (6 - last)]
            found.append([(0, middle_y, z), *[(x, y, z) for x, y in around], (0, middle_y, z)])
    return np.array(found)


@pytest.mark.slow
def test_the_racks_loops_are_its_six_handles():
    drawn, hand, boxes = skeletons(
        untangling(), lambda name: name.startswith(("rack", "post")), resolution=0.04
    )
    by_hand, by_boxes = (numbers(rack_curves(drawn), one) for one in (hand, boxes))
    assert by_boxes.shape == (6, 6) and round(abs(np.linalg.det(by_boxes))) == 1  # a basis of all handles
    assert np.linalg.matrix_rank(by_hand) == 6
    assert is_sum(by_boxes, by_hand)
    # of a storey's four faces one is the sum of the others
    three = [i for i, name in enumerate(hand.names) if not name.endswith("front")]
    assert is_sum(by_hand[:, three], by_boxes)


def fixture_curves(drawn, hand):
    """Through one fixture each, and back before it."""
    out = np.array([np.cos(TURNED), np.sin(TURNED), 0])
    way = np.array([out[1], -out[0], 0])
    found = []
    for loop in np.asarray(hand.loops):
        middle = loop[:-1].mean(0) + 0.02 * out
        corners = [middle - 0.05 * way, middle + 0.05 * way]
        corners += [corners[1] + 0.8 * out, corners[0] + 0.8 * out]
        found.append([*corners, corners[0]])
    return np.array(found)


def test_the_fixtures_loops_are_the_handles_that_they_make_with_the_wall():
    drawn, hand, boxes = skeletons(threading(), lambda name: name == "wall" or name in FIXTURES, 0.02)
    by_hand, by_boxes = (numbers(fixture_curves(drawn, hand), one) for one in (hand, boxes))
    np.testing.assert_array_equal(np.abs(by_hand), np.eye(3))
    assert by_boxes.shape == (3, 3) and is_sum(by_boxes, by_hand) and is_sum(by_hand, by_boxes)


@pytest.mark.parametrize("weights", [np.eye(2), [[2, 0], [0, 1]]])
def test_sums_are_told_from_what_is_none(weights):
    parts = np.array([[1, 0], [1, 1], [0, 1]])
    whole = (parts @ np.array(weights)).astype(int)
    assert is_sum(parts, whole) and is_sum(whole, parts) == (np.abs(np.linalg.det(weights)) == 1)
