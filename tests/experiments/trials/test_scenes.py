"""Scene sets and what is said of their difficulty."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.experiments.trials import scenes
from doojax.experiments.trials.difficulty import bottleneck, difficulty
from doojax.experiments.trials.evaluate import evaluate
from doojax.experiments.trials.record_files import load_record
from doojax.geometry.sdf import signed_distance
from doojax.tasks import make_task
from doojax.tasks.toy import HEIGHT, Toy
from tests.planning.problems import TOY, walls

from .toy_trials import PLANNING, SETTINGS


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
    assert read.caught and "held back" in scenes.rule(read.difficulty, read.caught)
    assert not scenes.draw_scenes(TOY, 1, 3).caught
    simulator = TOY.simulator()
    obstacles = jax.vmap(simulator.obstacles)(read.starts)
    rope = simulator.observations(read.starts).state
    bodies = jnp.concatenate([rope.points, rope.grippers], axis=1)
    distance = jax.vmap(signed_distance)(obstacles, bodies).min(1)
    assert (np.asarray(distance) < 0.01 + scenes.TOUCHING).all()  # the radius of rope and gripper is 1 cm
    assert (read.sizes["straight_clearance"] < 0).all()


class Noting(Toy):
    """The toy task; it notes on which engine it is simulated."""

    def simulator(self, engine="auto"):
        asked.append(engine)
        return super().simulator(engine)


asked = []


def test_scenes_do_not_depend_on_the_engine_that_a_machine_prefers():
    scenes.draw_scenes(Noting(), 1, 3, caught=True)
    assert set(asked) == {"mujoco"}


@pytest.mark.slow
def test_difficulties_are_what_they_say():
    easy = scenes.draw_scenes(TOY, 8, 3, "easy")
    narrow = scenes.draw_scenes(TOY, 1, 3, "narrow")  # its one wall leaves hardly any narrow ways
    dense = scenes.draw_scenes(make_task("toy", crowd=2), 8, 3, "dense")
    radius = TOY.scene.rope.radius
    for one in (easy, narrow, dense):
        assert (one.sizes["straight_clearance"] < 0).all() and (one.sizes["bottleneck"] > radius).all()
    assert (narrow.sizes["bottleneck"] <= 3 * radius).all() and easy.sizes["bottleneck"].max() > 3 * radius
    assert (easy.crowd, narrow.crowd, dense.crowd) == (1, 1, 2)
    assert dense.starts.obstacle_position.shape[1] == 2 * easy.starts.obstacle_position.shape[1]
    assert len({one.stream for one in (easy, narrow, dense)}) == 3
    starts = np.concatenate([one.starts.qpos for one in (easy, narrow, dense)])
    assert len(np.unique(starts, axis=0)) == 17  # each from a stream of its own


@pytest.mark.parametrize("name", ["rope_dragging", "dual_gripper"])
def test_a_crowd_is_twice_the_obstacles_but_for_what_encloses_them(name):
    one, two = make_task(name), make_task(name, crowd=2)
    fixed = {"rope_dragging": 4, "dual_gripper": 1}[name]
    count, double = len(one.scene.obstacles), len(two.scene.obstacles)
    assert double - fixed == 2 * (count - fixed)
    assert len({obstacle.name for obstacle in two.scene.obstacles}) == double
    assert len(two.start().placements.low) == double
    with pytest.raises(ValueError, match="crowd is 0, expected at least 1"):
        make_task(name, crowd=0)


def test_a_dense_set_is_read_as_one_and_evaluated_with_its_obstacles(tmp_path):
    scenes.scenes("toy", count=2, difficulty="dense", out=tmp_path / "toy.scenes")
    read = scenes.load_scenes(tmp_path / "toy.scenes")
    assert (read.difficulty, read.crowd, read.stream) == ("dense", 2, "scenes/toy/dense")
    near = eqx.tree_at(lambda g: g.tolerance, read.goals, np.full(2, 9.0, np.float32))
    scenes.save_scenes(tmp_path / "toy.scenes", replace(read, goals=near))  # reached at once
    evaluate(
        "toy",
        methods=("collision_checker",),
        scenes=tmp_path / "toy.scenes",
        out=tmp_path / "out",
        planning=PLANNING,
        budget=SETTINGS,
        side_by_side=2,
    )
    record = load_record(tmp_path / "out" / "collision_checker" / "00000.npz")
    assert record.obstacles.kind.shape == (2,)


def test_scenes_of_another_purpose_or_start_come_from_other_streams(tmp_path):
    mine, other = scenes.draw_scenes(TOY, 3, 3), scenes.draw_scenes(TOY, 3, 3, purpose="online")
    assert (mine.stream, other.stream) == ("scenes/toy/easy", "online/toy/easy")
    assert len(np.unique(np.concatenate([mine.starts.qpos, other.starts.qpos]), axis=0)) == 6
    scenes.save_scenes(tmp_path / "a.scenes", other)
    assert scenes.load_scenes(tmp_path / "a.scenes").stream == other.stream
    assert scenes.stream_names("engine_bay", "easy", False, fixed=True)[-1] == "fixed"
    with pytest.raises(ValueError, match="toy has no fixed start: leave --fixed out"):
        scenes.scenes("toy", count=1, fixed=True, out=tmp_path / "b.scenes")


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
