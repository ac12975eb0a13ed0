"""Scene sets and what is said of their difficulty."""

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.experiments import scenes
from doojax.experiments.difficulty import bottleneck, difficulty
from doojax.geometry.sdf import signed_distance
from doojax.tasks.toy import HEIGHT
from tests.planning.problems import TOY, walls


def widest_by_networkx(clearance, begin, end) -> float:
    """The least edge on the way through a maximum spanning tree is the bottleneck."""
    graph = nx.Graph()
    graph.add_nodes_from(np.ndindex(clearance.shape))
    for a in np.ndindex(clearance.shape):
        for step in ((1, 0), (0, 1), (1, 1), (1, -1)):
            b = (a[0] + step[0], a[1] + step[1])
            if b in graph:
                graph.add_edge(a, b, weight=min(clearance[a], clearance[b]))
    tree = nx.maximum_spanning_tree(graph)
    way = nx.shortest_path(tree, begin, end)
    return max(0.0, min(clearance[cell] for cell in way))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_a_bottleneck_is_what_a_spanning_tree_finds(seed):
    clearance = np.random.default_rng(seed).uniform(-0.5, 1, (6, 7))
    found = bottleneck(clearance, (0, 0), (5, 6))
    assert found == pytest.approx(widest_by_networkx(clearance, (0, 0), (5, 6)), abs=1e-3)


def one(obstacles):
    return jax.tree.map(lambda leaf: leaf[None], obstacles)


def test_difficulty_of_a_wall_with_a_gap_by_hand():
    """A wall along y at x = 0 from y = -0.5 to 0.3, 4 cm thick: the gap to the workspace's border is 0.2 m
    wide, and only the border's own cells, 0.2 m from the wall, bound the way there."""
    wall = walls(centre=(0.0, -0.1), half=(0.02, 0.4))
    begin, goal = np.array([[-0.4, 0.0, HEIGHT]]), np.array([[0.4, 0.0, HEIGHT]])
    sizes = difficulty(one(wall), begin, goal, TOY.workspace)
    assert sizes["distance"] == pytest.approx([0.8])
    assert sizes["straight_clearance"] == pytest.approx([-0.02], abs=1e-5)
    assert sizes["goal_clearance"] == pytest.approx([0.38], abs=1e-5)
    assert sizes["bottleneck"] == pytest.approx([0.2], abs=1e-3)
    across = difficulty(one(walls(centre=(0.0, 0.0), half=(0.02, 0.6))), begin, goal, TOY.workspace)
    assert across["bottleneck"] == [0.0]


def test_scenes_obey_the_rule_and_a_larger_set_begins_with_the_smaller(tmp_path):
    few, many = scenes.draw_scenes(TOY, 5, 3), scenes.draw_scenes(TOY, 40, 3)
    assert (len(few), len(many)) == (5, 40)
    assert (many.sizes["straight_clearance"] < 0).all() and (many.sizes["bottleneck"] > 0.01).all()
    assert np.array_equal(few.starts.qpos, many.starts.qpos[:5])
    assert np.array_equal(few.goals.targets, many.goals.targets[:5])
    assert len(np.unique(many.goals.targets[:, 0, 0])) == 40

    scenes.save_scenes(tmp_path / "a.scenes", few)
    scenes.save_scenes(tmp_path / "b.scenes", scenes.draw_scenes(TOY, 5, 3))
    assert (tmp_path / "a.scenes").read_bytes() == (tmp_path / "b.scenes").read_bytes()
    read = scenes.load_scenes(tmp_path / "a.scenes")
    assert (read.task, read.seed) == ("toy", 3)
    assert np.array_equal(read.starts.qpos, few.starts.qpos) and not read.starts.faults.any()
    assert np.array_equal(read.goals.bodies, few.goals.bodies)
    assert np.array_equal(read.sizes["distance"], few.sizes["distance"])


def test_where_the_rope_is_caught_an_obstacle_held_the_last_action_back(tmp_path):
    drawn = scenes.draw_scenes(TOY, 5, 3, caught=True)
    scenes.save_scenes(tmp_path / "caught.scenes", drawn)
    read = scenes.load_scenes(tmp_path / "caught.scenes")
    assert read.caught and "held back" in scenes.rule(read.caught)
    assert not scenes.draw_scenes(TOY, 1, 3).caught
    simulator = TOY.simulator()
    obstacles = jax.vmap(simulator.obstacles)(read.starts)
    rope = simulator.observations(read.starts).rope
    bodies = jnp.concatenate([rope.points, rope.grippers], axis=1)
    distance = jax.vmap(signed_distance)(obstacles, bodies).min(1)
    assert (np.asarray(distance) < 0.01 + scenes.TOUCHING).all()  # the radius of rope and gripper is 1 cm
    assert (read.sizes["straight_clearance"] < 0).all()


def test_files_that_are_no_scenes_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=jnp.zeros(3))
    with pytest.raises(ValueError, match=r"other.npz is not a file of scenes \(KeyError"):
        scenes.load_scenes(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError):
        scenes.load_scenes(tmp_path / "none.scenes")
    with pytest.raises(ValueError, match=r"a file of scenes ends in .scenes, got .*scenes.json"):
        scenes.save_scenes(tmp_path / "scenes.json", scenes.draw_scenes(TOY, 1, 0))
    with pytest.raises(ValueError, match="count is 0"):
        scenes.draw_scenes(TOY, 0, 0)
