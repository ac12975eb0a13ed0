"""An augmentation in the page, beside what it was made of."""

import re

import numpy as np
import pytest

from doojax.augmentation.command import augment_dataset
from doojax.augmentation.replay import original_of, replayed
from doojax.datasets import Dataset
from doojax.datasets.collect import collect
from doojax.datasets.diversity import nearest_distances, positions
from doojax.types import Verdict

from .test_page import rope_at


@pytest.fixture(scope="module")
def augmented(tmp_path_factory):
    folder = tmp_path_factory.mktemp("augmented")
    collect("toy", trajectories=6, states=3, out=folder / "data")
    augment_dataset(folder / "data", out=folder / "out", copies=3)
    return folder / "out"


def handles(app, name):
    (drawing,) = app._content._drawings
    return [key for key in drawing._handles if key.startswith(name)]


@pytest.mark.slow
def test_an_augmentation_stands_beside_its_original_and_its_search_is_gone_through(view, augmented):
    dataset = Dataset.open(augmented)
    verdict = dataset["verdict"][:]
    index = int(np.flatnonzero(verdict == Verdict.ACCEPTED)[0])
    look, app = view(augmented)
    look.wait_for(re.compile("^trajectory 0"))
    look.tab("Augmentation")
    look.wait_for("original")
    assert not handles(app, "beside")
    look.enter("Trajectory", index)
    look.wait_for("accepted")
    moved, own = dataset["points"][index][0], dataset["points"][original_of(dataset, index)][0]
    look.until(lambda: rope_at(look, app, moved[2]))
    assert handles(app, "beside")
    search = replayed(dataset, index)
    look.page.get_by_role("button", name="Search again").click()
    look.until(lambda: handles(app, "search") != [])
    assert look.number("Step") == len(search.transforms) - 1
    look.enter("Step", 0)
    look.until(lambda: np.allclose(app._content._augmentation.places(0.0)[0], own, atol=1e-6))
    look.choose("Beside it", "nothing")
    look.until(lambda: not handles(app, "beside") and not handles(app, "search"))


def test_the_nearest_original_is_found(view, augmented):
    dataset = Dataset.open(augmented)
    verdict = dataset["verdict"][:]
    index = int(np.flatnonzero(verdict == Verdict.ACCEPTED)[-1])
    originals = np.flatnonzero(verdict == Verdict.ORIGINAL)
    _, (nearest,) = nearest_distances(positions(dataset, np.array([index])), positions(dataset, originals))
    look, app = view(augmented)
    look.wait_for(re.compile("^trajectory 0"))
    look.tab("Augmentation")
    look.enter("Trajectory", index)
    look.wait_for(re.compile(f"nearest original: row {originals[nearest]}"))
    look.choose("Beside it", "the nearest original")
    look.until(lambda: app._content._augmentation.beside == originals[nearest])


def test_a_rejected_one_says_why(view, augmented):
    dataset = Dataset.open(augmented)
    index = int(np.flatnonzero(dataset["verdict"][:] > Verdict.ACCEPTED)[0])
    name = Verdict(int(dataset["verdict"][index])).name.lower().replace("_", " ")
    look, app = view(augmented)
    look.wait_for(re.compile("^trajectory 0"))
    look.tab("Augmentation")
    look.enter("Trajectory", index)
    look.wait_for(name)
    look.until(lambda: handles(app, "beside") != [])  # of what it would have been made
    assert not handles(app, "now/rope")
