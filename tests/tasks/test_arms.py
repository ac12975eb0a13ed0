"""Scenes of arms and a fastened rope: what is drawn is where the rules say."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.geometry.sdf import signed_distance
from doojax.keys import generator
from doojax.simulation.scenes import obstacles_at
from doojax.tasks.arms import BASE, drawn_start, rope_ends
from doojax.tasks.pulling import HEAD, KEPT, OUT_OF_REACH, RADIUS, pulling
from doojax.tasks.untangling import HALF_WIDTHS, untangling

UNTANGLING, PULLING = untangling(), pulling()
DRAWS = 20


def draws(task):
    return [task.draw(task, generator(0, "test", task.name, str(i))) for i in range(DRAWS)]


@pytest.fixture(scope="module")
def distance():
    """Of points to a drawn scene's obstacles, m."""

    @partial(jax.jit, static_argnums=0)
    def inner(scene, centres, points):
        quaternions = jnp.tile(jnp.array([1.0, 0, 0, 0]), (len(centres), 1))
        return signed_distance(obstacles_at(scene, centres, quaternions), points)

    def outer(task, drawn, points):
        centres = jnp.array([drawn.centres[one.name] for one in task.scene.obstacles])
        return np.asarray(inner(task.scene, centres, jnp.asarray(points)))

    return outer


def test_the_skeletons_loops_run_within_the_rack(distance):
    steps = np.linspace(0, 1, 21)[:, None, None]
    for drawn in draws(UNTANGLING):
        loops = UNTANGLING.loops(drawn.centres)
        assert len(loops) == 8
        for loop in loops.values():
            np.testing.assert_array_equal(loop[0], loop[-1])
        points = np.stack(list(loops.values()))
        along = points[:, :-1] + steps[..., None] * (points[:, 1:] - points[:, :-1])
        assert distance(UNTANGLING, drawn, along.reshape(-1, 3)).max() < 1e-5


def test_the_middles_of_the_loops_are_open_but_for_the_box(distance):
    for drawn in draws(UNTANGLING):
        middles = np.stack([loop[:-1].mean(0) for loop in UNTANGLING.loops(drawn.centres).values()])
        assert distance(UNTANGLING, drawn, middles).min() > 0.03


def test_the_rack_is_as_wide_as_drawn_and_the_cable_begins_at_the_wall():
    widths = []
    for drawn in draws(UNTANGLING):
        half = abs(drawn.centres["post0"][0])
        widths.append(half)
        for shelf, size in (("rack1_bottom", 0.2), ("rack2_bottom", 0.2), ("rack2_top", 0.21)):
            left, right = (drawn.centres[f"{shelf}_{side}"][0] for side in ("left", "right"))
            more = 0.02 if shelf == "rack2_top" else 0
            np.testing.assert_allclose([left - size, right + size], [-half - more, half + more], atol=1e-9)
            assert left + size >= right - size  # they overlap: no gap between the halves
        np.testing.assert_allclose(drawn.rope[0], drawn.centres["attach"])
        np.testing.assert_allclose(np.linalg.norm(np.diff(drawn.rope, axis=0), axis=1), 1 / 11, rtol=1e-6)
        assert drawn.centres["attach"][0] > drawn.centres["left_wall"][0] + 0.01
        computer = drawn.centres["computer"]
        np.testing.assert_allclose(drawn.goal - computer, [-0.04, -0.19, 0.05], atol=1e-9)
    low, high = HALF_WIDTHS
    assert low <= min(widths) < low + 0.05 and high - 0.05 < max(widths) <= high


def test_the_hoses_head_is_out_of_reach_and_the_hose_on_the_floor():
    for drawn in draws(PULLING):
        head = drawn.rope[-1]
        assert all(low <= value <= high for value, (low, high) in zip(head[:2], HEAD, strict=True))
        assert np.linalg.norm(head[:2]) > OUT_OF_REACH
        assert np.linalg.norm(drawn.rope[:, :2], axis=1).min() > KEPT
        np.testing.assert_allclose(drawn.rope[-10:, 2], RADIUS + 0.002, atol=1e-6)
        np.testing.assert_allclose(drawn.rope[0], drawn.centres["attach"])
        assert np.linalg.norm(drawn.goal[:2] - [0, 0.5]) < 0.08 and drawn.goal[2] == 0.03


def test_draws_differ_and_are_repeated_by_their_names():
    one, other = draws(UNTANGLING)[:2]
    assert np.abs(one.goal - other.goal).max() > 1e-3
    again = UNTANGLING.draw(UNTANGLING, generator(0, "test", "untangling", "0"))
    np.testing.assert_array_equal(one.goal, again.goal)


@pytest.mark.slow
def test_a_start_holds_the_cables_end_clear_of_everything():
    simulator = UNTANGLING.simulator()
    start = drawn_start(UNTANGLING, simulator, 0, 0)
    seen = simulator.observation(start.state)
    tip = rope_ends(UNTANGLING.scene, seen)[-1]
    assert np.linalg.norm(tip - seen.hands[1]) < 5e-3
    assert np.isnan(start.places[0]) and start.places[1] == 1.0
    first = start.state.obstacle_position[-1]
    np.testing.assert_allclose(rope_ends(UNTANGLING.scene, seen)[0], first, atol=5e-3)
    skeleton = UNTANGLING.skeleton(start.state)
    assert skeleton.loops.shape == (8, 5, 3) and float(skeleton.loops[..., 2].min()) < -BASE[2] + 0.1
    again = drawn_start(UNTANGLING, simulator, 0, 0)
    np.testing.assert_array_equal(start.state.qpos, again.state.qpos)
