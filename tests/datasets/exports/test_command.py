"""doojax export: all or nothing, never over what is there; and the real readers read it."""

import os
import subprocess
import sys
import textwrap

import pytest

from doojax.cli import main
from doojax.datasets.exports import command
from doojax.datasets.exports.command import export, made_whole

from .conftest import K, T


@pytest.mark.parametrize(("layout", "name"), [("lerobot", "known"), ("minari", "known-v0")])
def test_a_word_says_how_many_and_nothing_else_is_left_beside(layout, name, folder, tmp_path, capsys):
    assert main(["export", str(folder), "--format", layout, "--out", str(tmp_path / name)]) == 0
    said = capsys.readouterr().err
    assert f"{K - 1} episodes of {T} steps" in said and "train, " in said
    assert "trajectories without values, left out: 1" in said
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_what_is_there_is_never_overwritten(folder, tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("dear")
    assert main(["export", str(folder), "--format", "lerobot", "--out", str(tmp_path / "mine")]) == 2
    assert "holds notes.txt: choose a new or empty folder" in capsys.readouterr().err.replace("\n", " ")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file"):
        export(folder, format="lerobot", out=tmp_path / "file")


def test_an_export_that_fails_leaves_nothing_and_one_that_was_killed_is_cleared_away(tmp_path):
    with pytest.raises(RuntimeError), made_whole(tmp_path / "out") as half:
        (half / "some").write_text("x")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    (tmp_path / ".out.partial/data").mkdir(parents=True)
    with made_whole(tmp_path / "out") as half:
        assert list(half.iterdir()) == []
        (half / "whole").write_text("x")
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "whole"]


def test_a_minari_data_set_needs_a_name_with_a_version(folder, tmp_path):
    with pytest.raises(ValueError, match=r"'my ropes' is no name .* as in my_ropes-v0"):
        export(folder, format="minari", out=tmp_path / "my ropes")
    with pytest.raises(FileNotFoundError, match="no data set at"):
        export(tmp_path / "none", format="minari", out=tmp_path / "x-v0")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_package_is_named_with_its_extra(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(command.NEEDS, "minari", "no_such_package")
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        export(folder, format="minari", out=tmp_path / "x-v0")


MINARI = """
    import minari, sys, numpy as np
    dataset = minari.load_dataset("known-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (10, 30)
    for episode in dataset:
        states = [{name: values[t] for name, values in episode.observations.items()} for t in range(4)]
        assert all(dataset.observation_space.contains(state) for state in states)
        assert all(dataset.action_space.contains(action) for action in episode.actions)
        assert len(episode) == 3 and episode.truncations[-1] and repr(episode)
    (first,) = dataset.sample_episodes(1)
    splits = [one["split"] for one in dataset.storage.get_episode_metadata(range(10))]
    print(sorted(set(splits)), minari.list_local_datasets().keys())
"""
LEROBOT = """
    import sys
    from pathlib import Path
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    dataset = LeRobotDataset("doojax/known", root=Path(sys.argv[1]), delta_timestamps={"action": [0.0, STEP]})
    assert (len(dataset), dataset.num_episodes) == (30, 10)
    frame = dataset[1]
    assert frame["observation.state"].shape == (18,) and frame["action"].shape == (2, 3)
    assert (frame["next.observation.state"] == dataset[2]["observation.state"]).all()
    assert dataset[2]["action_is_pad"].tolist() == [False, True]
    assert frame["task"] == "toy: random actions"
    assert dataset.meta.stats["action"]["mean"].shape == (3,)
    print(dataset.meta.episodes[0]["split"])
"""


def read_by(python, code, *arguments, **environment):
    """What a program prints that another Python runs, which has no doojax."""
    ran = subprocess.run(
        [python, "-c", textwrap.dedent(code), *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.slow  # imports torch
def test_lerobot_itself_reads_it(folder, tmp_path):
    python = os.environ.get("LEROBOT_PYTHON")
    if not python:
        pytest.skip("LEROBOT_PYTHON names no Python with lerobot[dataset], which is gigabytes of torch")
    export(folder, format="lerobot", out=tmp_path / "known")
    from doojax.tasks import make_task

    period = str(make_task("toy").scene.control_period)
    said = read_by(
        python,
        LEROBOT.replace("STEP", period),
        str(tmp_path / "known"),
        HF_HUB_OFFLINE="1",
        HOME=str(tmp_path),
    )
    assert said == "train\n"


@pytest.mark.slow  # an environment of its own
def test_minari_itself_reads_it(folder, tmp_path):
    export(folder, format="minari", out=tmp_path / "all/known-v0")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    python = str(tmp_path / "venv/bin/python")
    subprocess.run([python, "-m", "pip", "install", "-q", "minari[hdf5]", "pillow"], check=True, timeout=600)
    said = read_by(python, MINARI, MINARI_DATASETS_PATH=str(tmp_path / "all"))
    assert "'train'" in said and "known-v0" in said
