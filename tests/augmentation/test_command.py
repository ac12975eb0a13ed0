"""`doojax augment` on a small collection of the toy task, whose physics are known."""

import functools
import io
from contextlib import redirect_stdout

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.augmentation import command, usual
from doojax.augmentation.command import augment_dataset
from doojax.augmentation.examples import Bounds
from doojax.augmentation.objectives import Weights
from doojax.commands import parsed
from doojax.datasets import Dataset
from doojax.datasets.collect import collect, command_of
from doojax.datasets.diversity import diversity
from doojax.datasets.inspect import inspect
from doojax.datasets.replay import replay, stored_starts
from doojax.files import file_digest
from doojax.learning.data import load_split
from doojax.tasks import make_task
from doojax.types import Verdict

COPIES, TRAJECTORIES, STATES = 2, 24, 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("augmented")
    collect("toy", trajectories=TRAJECTORIES, states=STATES, out=folder / "data")
    augment_dataset(folder / "data", out=folder / "whole", copies=COPIES)
    return folder


@functools.cache
def opened(path):
    return Dataset.open(path)


def test_rows_say_where_they_come_from(folder):
    data, whole = opened(folder / "data"), opened(folder / "whole")
    assert len(whole) == TRAJECTORIES * (1 + COPIES)
    np.testing.assert_array_equal(whole["original"][:], np.repeat(np.arange(TRAJECTORIES), 1 + COPIES))
    np.testing.assert_array_equal(whole["environment"][:], data["environment"][:].repeat(1 + COPIES))
    verdict = whole["verdict"][:].reshape(TRAJECTORIES, 1 + COPIES)
    assert (verdict[:, 0] == Verdict.ORIGINAL).all() and (verdict[:, 1:] != Verdict.ORIGINAL).all()
    for name in data.fields:
        np.testing.assert_array_equal(whole[name][:: 1 + COPIES], data[name][:])


def test_accepted_rows_are_moved_originals_and_rejected_ones_are_no_copies(folder):
    whole = opened(folder / "whole")
    verdict, original = whole["verdict"][:], whole["original"][:] * (1 + COPIES)
    accepted, rejected = verdict == Verdict.ACCEPTED, verdict > Verdict.ACCEPTED
    assert accepted.sum() > 10 and rejected.sum() > 2
    assert np.isnan(whole["points"][:][rejected]).all() and np.isnan(whole["actions"][:][rejected]).all()
    transform, centre = whole["transform"][:][accepted], whole["centre"][:][accepted]
    assert not transform[:, 2:5].any()  # the toy's ropes stay in their plane
    cosine, sine = np.cos(transform[:, 5]), np.sin(transform[:, 5])
    turn = np.zeros((len(cosine), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cosine, -sine, sine, cosine, 1
    for name in ("points", "grippers"):
        before, after = whole[name][:][original[accepted]], whole[name][:][accepted]
        expected = np.einsum("bij,btnj->btni", turn, before - centre[:, None, None])
        expected += (centre + transform[:, :3])[:, None, None]
        np.testing.assert_allclose(after, expected, atol=1e-6)
    actions = whole["actions"][:]
    expected = np.einsum("bij,btnj->btni", turn, actions[original[accepted]])
    np.testing.assert_allclose(actions[accepted], expected, atol=1e-7)


def test_stored_starts_are_starts_of_the_moved_trajectories(folder):
    """The toy's physics turn with the rope: simulating a moved start gives the moved trajectory."""
    whole = opened(folder / "whole")
    rows = np.flatnonzero(whole["verdict"][:] == Verdict.ACCEPTED)
    _, again = (
        make_task("toy").simulator().rollout(stored_starts(whole, rows), jnp.asarray(whole["actions"][rows]))
    )
    errors = np.abs(np.asarray(again.states.points) - whole["points"][rows]).max((1, 2, 3))
    assert np.quantile(errors, 0.9) < 1e-5  # the wall stops grippers in steps of a twentieth of an action


def test_splits_have_the_same_scenes_and_training_leaves_rejected_rows_out(folder):
    data, whole = opened(folder / "data"), opened(folder / "whole")
    for split in ("train", "validation", "test"):
        scenes = [set(one["environment"][one.split(split)].tolist()) for one in (data, whole)]
        assert scenes[0] == scenes[1]
    rows = np.asarray(load_split(whole, "train").rows)
    assert set(whole["verdict"][rows].tolist()) == {Verdict.ORIGINAL, Verdict.ACCEPTED}


def test_stopped_between_shards_it_goes_on_to_the_same_bytes(folder, tmp_path, monkeypatch):
    class Stopped(BaseException):
        pass

    shard = command._shard
    begun = []

    def stop_at_the_second(*arguments):
        begun.append(arguments)
        if len(begun) == 2:
            raise Stopped
        return shard(*arguments)

    monkeypatch.setattr(command, "_shard", stop_at_the_second)
    with pytest.raises(Stopped):
        augment_dataset(folder / "data", out=tmp_path / "stopped", copies=COPIES)
    augment_dataset(folder / "data", out=tmp_path / "stopped", copies=COPIES)
    assert len(begun) == 3  # the first shard was not made again
    files = [file for file in (folder / "whole").rglob("*") if file.is_file()]
    for file in files:
        assert file_digest(file) == file_digest(tmp_path / "stopped" / file.relative_to(folder / "whole"))


@pytest.mark.slow
def test_transitions(folder, tmp_path):
    augment_dataset(folder / "data", out=tmp_path, copies=1, steps=1)
    data, cut = opened(folder / "data"), opened(tmp_path)
    assert len(cut) == TRAJECTORIES * (STATES - 1) * 2
    assert cut["points"].shape[1] == 2
    np.testing.assert_array_equal(cut["first_period"][:6], [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(cut["points"][4], data["points"][0][2:4])
    np.testing.assert_array_equal(cut["actions"][4], data["actions"][0][2:3])
    with pytest.raises(ValueError, match=r"the start of trajectory 4 of .* is not stored"):
        replay(tmp_path, trajectory=4)


def test_inspect_says_what_was_accepted_and_the_command(folder):
    whole, text = opened(folder / "whole"), io.StringIO()
    with redirect_stdout(text):
        inspect(folder / "whole")
    accepted = int((whole["verdict"][:] == Verdict.ACCEPTED).sum())
    assert f"augmentations: accepted: {accepted} of {TRAJECTORIES * COPIES}" in text.getvalue()
    line = command_of(whole.manifest, folder / "again")
    assert line is not None
    ((function, given),) = parsed(line)
    assert function is augment_dataset
    assert (given["data"], given["copies"], given["weights"]) == (folder / "data", COPIES, Weights())
    assert (given["translation"], given["rotation"]) == (Bounds().translation, Bounds().rotation)


def test_bounds_and_tolerance_are_the_tasks_own():
    pushing, ropes = usual(make_task("planar_pushing")), usual(make_task("rope_dragging"))
    assert pushing[0].translation == (0.15, 0.15, 0.0) and ropes[0] == Bounds()
    assert pushing[1].distance_tolerance < ropes[1].distance_tolerance


def test_of_several_targets_that_is_taken_which_makes_transforms_uniform(folder, tmp_path):
    for tries in (1, 4):
        augment_dataset(folder / "data", out=tmp_path / str(tries), copies=12, tries=tries)
    once, often = opened(tmp_path / "1"), opened(tmp_path / "4")
    assert (often["verdict"][:] == Verdict.ACCEPTED).sum() >= (once["verdict"][:] == Verdict.ACCEPTED).sum()
    assert diversity(often).accepted < 0.5 * diversity(once).accepted
    line = command_of(often.manifest, tmp_path / "again")
    assert line is not None and parsed(line)[0][1]["tries"] == 4


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"copies": 0}, "copies is 0, expected at least 1"),
        ({"tries": 0}, "tries is 0, expected at least 1"),
        ({"steps": 4}, "steps is 4, expected 1 to 3, as many as the trajectories have"),
        ({"translation": (0.0, 0.0, 0.1), "rotation": (0.1, 0.0, 0.0)}, "the range of transforms is zero"),
        ({"seed": -1}, "the seed is -1"),
    ],
)
def test_bad_options(folder, tmp_path, given, message):
    with pytest.raises(ValueError, match=message):
        augment_dataset(folder / "data", out=tmp_path / "out", **given)


def test_data_that_are_augmented_already(folder, tmp_path):
    with pytest.raises(ValueError, match=r"is augmented already: augment .*data"):
        augment_dataset(folder / "whole", out=tmp_path / "out")


def test_a_data_set_says_how_varied_its_augmentations_are(folder, capsys):
    whole = opened(folder / "whole")
    found, verdict = diversity(whole), whole["verdict"][:]
    places = np.concatenate([whole["points"][:], whole["grippers"][:]], axis=2)
    moved, kept = (places[verdict == which] for which in (Verdict.ACCEPTED, Verdict.ORIGINAL))
    gaps = ((moved[:, None] - kept[None]) ** 2).sum(-1).mean((2, 3)) ** 0.5
    assert found.nearest == pytest.approx(np.median(gaps.min(1)), rel=1e-5)
    assert found.accepted > found.drawn > 0  # the projection does not reach all targets
    inspect(folder / "whole")
    told = capsys.readouterr().out
    assert f"{found.drawn:.3f} nats as drawn, {found.accepted:.3f} as accepted" in told
