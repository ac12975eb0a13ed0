"""Collecting: what is refused, what is replayed, and what a kill leaves behind."""

import hashlib
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.datasets import Dataset
from doojax.datasets.collect import collect
from doojax.datasets.replay import replay, save_failures
from doojax.simulation.state import Fault
from doojax.tasks import make_task
from doojax.tasks.rope_dragging import RopeDragging
from doojax.tasks.starts import RandomStart

COMMAND = [sys.executable, "-m", "doojax.cli", "collect", "toy", "--trajectories", "640", "--states", "8"]


def digest(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.slow
def test_killed_and_resumed_collections_have_the_bytes_of_an_uninterrupted_one(tmp_path):
    """Killed when some shards are complete; test_kill_resume stops a writer anywhere."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    collect("toy", trajectories=640, states=8, out=whole)
    process = subprocess.Popen(
        [*COMMAND, "--out", str(broken)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        limit = time.monotonic() + 200
        while len(list(broken.glob("shards/*.json"))) < 2:
            assert process.poll() is None and time.monotonic() < limit
            time.sleep(0.002)
    finally:
        process.kill()
        said = process.communicate()[1]
    assert 2 <= len(list(broken.glob("shards/*.json"))) < 10, said
    collect("toy", trajectories=640, states=8, out=broken)
    assert digest(broken) == digest(whole)


FEW = 6  # toy trajectories: as many as the last shard of 70 has, so that one program simulates both


@pytest.fixture(scope="module")
def three(tmp_path_factory) -> Path:
    """A collection of dragging."""
    folder = tmp_path_factory.mktemp("dragging") / "three"
    collect("rope_dragging", trajectories=3, states=3, engine="mujoco", out=folder)
    return folder


def test_a_stored_trajectory_replays_bit_for_bit(three, capsys):
    replay(three, trajectory=2)
    assert "the replay equals what was stored, bit for bit" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"there is no trajectory 3: .* holds 0 to 2"):
        replay(three, trajectory=3)


def test_a_longer_collection_begins_with_the_same_trajectories(tmp_path):
    collect("toy", trajectories=FEW, states=3, out=tmp_path / "few")
    collect("toy", trajectories=70, states=3, out=tmp_path / "seventy")
    few, many = Dataset.open(tmp_path / "few"), Dataset.open(tmp_path / "seventy")
    np.testing.assert_allclose(few["points"][:], many["points"][:FEW], atol=1e-6)


@pytest.mark.slow
def test_a_trajectory_does_not_know_what_is_simulated_beside_it(three, tmp_path):
    collect("rope_dragging", trajectories=66, states=3, engine="mujoco", out=tmp_path / "more")
    few, many = Dataset.open(three), Dataset.open(tmp_path / "more")
    for name in few.fields:
        assert np.array_equal(few[name][:], many[name][:3]), name


def test_failures_are_saved_and_replayed(tmp_path, capsys):
    task = make_task("rope_dragging", phase="unconstrained")
    simulator = task.simulator("mujoco")
    starts = jax.jit(jax.vmap(simulator.reset))(jax.random.split(jax.random.key(0), 3))
    starts = eqx.tree_at(lambda s: s.qvel, starts, starts.qvel.at[1, 0].set(jnp.inf))
    actions = jnp.full((3, 2, 1, 3), 0.01)
    _, seen = simulator.rollout(starts, actions)
    assert save_failures(tmp_path / "failed.npz", "rope_dragging", starts, actions, seen) == 1
    replay(tmp_path / "failed.npz")
    assert "NOT_FINITE" in capsys.readouterr().out


def test_an_overfull_scene_says_so():
    task = RopeDragging()
    start = task.start()

    crowded = RandomStart(
        start.bank,
        scene=task.scene,
        place_rope=lambda key, points: (-points.mean(0).at[2].set(0.0), jnp.array(0.0)),
        placements=jax.tree.map(lambda leaf: leaf.at[0].set(0.0), start.placements),  # on the rope
    )
    state = crowded(jax.random.key(0))
    assert int(state.faults) == int(Fault.SCENE_OVERFULL)
    assert float(state.obstacle_position[0, 2]) < -5  # parked


def test_bad_requests_are_refused(tmp_path):
    for wanted, words in (
        ({"task": "knots"}, "unknown task 'knots'"),
        ({"trajectories": -3}, "trajectories is -3, expected at least 1"),
        ({"states": 1}, "states is 1, expected at least 2"),
        ({"engine": "bullet"}, "unknown engine 'bullet'"),
    ):
        request = {"task": "toy", "trajectories": 2, "states": 3} | wanted
        with pytest.raises(ValueError, match=words):
            collect(request.pop("task"), out=tmp_path / "none", **request)
        assert not (tmp_path / "none").exists()


def test_another_collections_folder_is_refused(tmp_path):
    collect("toy", trajectories=FEW, states=3, out=tmp_path / "data")
    with pytest.raises(ValueError, match="seed"):
        collect("toy", trajectories=FEW, states=3, seed=1, out=tmp_path / "data")
    assert replace(Dataset.open(tmp_path / "data").manifest).config["seed"] == 0


def test_data_of_another_scene_are_told(tmp_path, capsys):
    scene = make_task("toy").scene
    assert scene.digest == make_task("toy").scene.digest != replace(scene, timestep=0.001).digest
    collect("toy", trajectories=FEW, states=3, out=tmp_path / "data")
    manifest = tmp_path / "data" / "manifest.json"
    manifest.write_text(manifest.read_text().replace(scene.digest, "0123456789abcdef"))
    replay(tmp_path / "data")
    assert "the scene of toy has changed since these were collected" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"config.scene: .*0123456789abcdef"):
        collect("toy", trajectories=FEW, states=3, out=tmp_path / "data")
    manifest.write_text(re.sub(r'"scene": "0123456789abcdef",', "", manifest.read_text()))
    replay(tmp_path / "data")
    assert "of which scene of toy these are is not recorded" in capsys.readouterr().out
