"""Bodies that a hand pushes: what is drawn of them, in films and in the page."""

import re

import numpy as np
import pytest

from doojax.augmentation.command import augment_dataset
from doojax.augmentation.replay import original_of, replayed
from doojax.datasets import Dataset
from doojax.datasets.collect import collect
from doojax.types import Verdict
from doojax.viewer import colours
from doojax.viewer.films import film_of_trajectory
from doojax.viewer.pictures import frames
from doojax.viewer.render import most_moving, render

RADIUS = 0.02


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pushed")
    collect("planar_pushing", trajectories=6, states=30, out=folder / "data", engine="mujoco")
    augment_dataset(folder / "data", out=folder / "out", copies=2)
    return folder


class Noted:
    """A drawing that keeps what it is told, by name."""

    def __init__(self):
        self.spheres_, self.lines_ = {}, {}

    def spheres(self, name, centres, *, radius, colours, opacity=1.0):
        self.spheres_[name] = np.asarray(centres), radius

    def lines(self, name, segments, *, width, colours):
        self.lines_[name] = np.asarray(segments)

    def remove(self, name):
        self.lines_.pop(name, None)

    def _unexpected(self, *given, **how):
        raise AssertionError("nothing else is to be drawn")

    rope = points = cones = obstacles = bodies = axes = text = _unexpected


def test_bodies_and_hand_are_where_they_are_and_their_ways_behind_them(pushed):
    dataset = Dataset.open(pushed / "data")
    (index,) = most_moving(dataset, 1)
    places, hand = dataset["positions"][index], dataset["hand"][index]
    travelled = np.linalg.norm(np.diff(dataset["positions"][:], axis=1), axis=-1).sum((1, 2))
    assert index == travelled.argmax() and travelled[index] > 0.01
    film, drawing = film_of_trajectory(dataset, index), Noted()
    assert film.planar and film.states == 30
    film.show(drawing, 12.5)
    bodies, radius = drawing.spheres_["now/rope"]
    np.testing.assert_allclose(bodies, (places[12] + places[13]) / 2, atol=1e-7)
    assert radius == pytest.approx(RADIUS)
    grippers, radius = drawing.spheres_["now/grippers"]
    np.testing.assert_allclose(grippers, ((hand[12] + hand[13]) / 2)[None], atol=1e-7)
    assert radius == pytest.approx(RADIUS)
    assert len(drawing.lines_["trail/bodies"]) == 12 * 9 and len(drawing.lines_["trail/grippers"]) == 12
    np.testing.assert_allclose(drawing.lines_["trail/grippers"][-1], hand[11:13])


def test_pictures_show_as_much_of_them_as_there_is(pushed, tmp_path):
    """Nine discs of a square metre's share that pixels count, less what the hand hides."""
    dataset = Dataset.open(pushed / "data")
    film = film_of_trajectory(dataset, 0)
    (picture,) = frames(film, [29.0])
    like = [
        np.abs(picture.astype(int) - np.array(one)).max(-1) < 60 for one in (colours.ROPE, colours.GRIPPER)
    ]
    assert like[0].sum() > 5 * like[1].sum() > 0
    render(pushed / "data", out=tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").stat().st_size > 10_000


def test_of_a_search_what_rests_stays(pushed):
    dataset = Dataset.open(pushed / "out")
    accepted = np.flatnonzero(dataset["verdict"][:] == Verdict.ACCEPTED)
    assert accepted.size
    for index in accepted.tolist():
        original, found = original_of(dataset, index), replayed(dataset, index)
        before = dataset["positions"][original]
        rests = np.linalg.norm(before - before[:1], axis=-1).max(0) < 1e-4
        gaps = np.abs(found.transforms - dataset["transform"][index]).max(1)
        places, hand = found.places(int(gaps.argmin()))
        np.testing.assert_array_equal(places[:, rests], before[:, rests])
        # one element is rounded otherwise than a batch, and many steps of a search magnify that
        np.testing.assert_allclose(places, dataset["positions"][index], atol=1e-4)
        np.testing.assert_allclose(hand[:, 0], dataset["hand"][index], atol=1e-4)
        assert 0 < rests.sum() < 9 or not (~rests).any()


@pytest.mark.slow
def test_an_augmentation_of_pushing_stands_beside_its_original(view, pushed):
    dataset = Dataset.open(pushed / "out")
    index = int(np.flatnonzero(dataset["verdict"][:] == Verdict.ACCEPTED)[0])
    look, app = view(pushed / "out")
    look.wait_for(re.compile("^trajectory 0"))
    look.tab("Augmentation")
    look.enter("Trajectory", index)
    look.wait_for("accepted")
    (drawing,) = app._content._drawings
    look.until(lambda: any(key.startswith("beside/rope") for key in drawing._handles))
    look.page.get_by_role("button", name="Search again").click()
    look.until(lambda: any(key.startswith("search/rope") for key in drawing._handles))
