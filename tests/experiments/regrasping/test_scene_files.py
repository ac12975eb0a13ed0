"""Scenes of arms in files: what is written is read again, and what is none of it is refused."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from doojax.experiments.regrasping import scenes as module
from doojax.experiments.regrasping.scenes import (
    arm_scene_file,
    load_arm_scenes,
    regrasp_scenes,
    save_arm_scenes,
    scenes_of,
    task_of,
)
from tests.experiments.regrasping import scenes

START = scenes.start()._replace(places=(float("nan"), 0.5), attempt=3, refused=("it was wet", "it was wet"))


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "hanging.scenes"
    save_arm_scenes(path, scenes_of(scenes.TASK, 7, [START, START._replace(attempt=0)]))
    return path


def test_what_is_written_is_read_again(file):
    found = load_arm_scenes(file, scenes.TASK)
    assert len(found) == 2 and found.header.seed == 7 and found.header.attempts == (3, 0)
    assert found.header.refused == {"it was wet": 4} and "solvable in principle" in found.header.rule
    again = found.start(0)
    assert jax.tree.all(jax.tree.map(lambda a, b: (np.asarray(a) == b).all(), again.state, START.state))
    np.testing.assert_array_equal(again.goal, START.goal)
    np.testing.assert_array_equal(again.places, START.places)


def test_the_same_scenes_are_the_same_bytes(file, tmp_path):
    save_arm_scenes(tmp_path / "again.scenes", load_arm_scenes(file, scenes.TASK))
    assert (tmp_path / "again.scenes").read_bytes() == file.read_bytes()


def test_scenes_of_another_physics_are_refused(file):
    other = replace(scenes.TASK, scene=replace(scenes.SCENE, viscosity=0.5))
    with pytest.raises(ValueError, match=r"it holds scenes of hanging, as simulated by .*: draw scenes with"):
        load_arm_scenes(file, other)


def test_files_of_another_kind_are_refused(tmp_path):
    path = tmp_path / "other.scenes"
    header = np.frombuffer(json.dumps({"format": "doojax scenes", "version": 2}).encode(), np.uint8)
    with path.open("wb") as stream:
        np.savez(stream, header=header)
    with pytest.raises(
        ValueError, match="its format is 'doojax scenes', version 2, expected 'doojax arm sce"
    ):
        load_arm_scenes(path, scenes.TASK)
    with pytest.raises(ValueError, match=r"ends in \.scenes, got .*scenes\.npz"):
        save_arm_scenes(tmp_path / "scenes.npz", scenes_of(scenes.TASK, 0, [START]))


def test_wrong_requests_are_refused(tmp_path):
    with pytest.raises(
        ValueError, match="unknown environment 'knitting', expected one of pulling, untangling"
    ):
        task_of("knitting")
    with pytest.raises(ValueError, match="count is 0, expected 1 or more"):
        regrasp_scenes("pulling", out=tmp_path / "none.scenes", count=0)


def test_without_a_file_of_ones_own_the_one_that_comes_along_is_taken_if_one_does(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "FOLDER", tmp_path)
    assert arm_scene_file(None, scenes.TASK) is None
    (tmp_path / "hanging.scenes").touch()
    assert arm_scene_file(None, scenes.TASK) == tmp_path / "hanging.scenes"
    assert arm_scene_file(tmp_path / "own.scenes", scenes.TASK) == tmp_path / "own.scenes"
