"""The search for an augmentation again, step by step."""

import numpy as np
import pytest

from doojax.augmentation.command import augment_dataset
from doojax.augmentation.objectives import Weights
from doojax.augmentation.replay import original_of, replayed
from doojax.datasets import Dataset
from doojax.datasets.collect import collect
from doojax.types import Verdict


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("replayed")
    collect("toy", trajectories=12, states=3, out=folder / "data")
    weights = Weights(distance=0.2)
    augment_dataset(folder / "data", out=folder / "out", copies=3, steps=1, weights=weights, seed=4)
    return Dataset.open(folder / "out")


def test_the_search_ends_where_the_augmentation_is(made):
    accepted = np.flatnonzero(made["verdict"][:] == Verdict.ACCEPTED).tolist()
    assert len(accepted) > 10
    far = 0
    for index in accepted[:10]:
        found = replayed(made, index)
        np.testing.assert_array_equal(found.transforms[0], 0.0)
        np.testing.assert_allclose(found.centre, made["centre"][index], atol=1e-6)
        gaps = np.abs(found.transforms - made["transform"][index]).max(1)
        assert gaps.min() < 1e-6  # it was looked at, and what is looked at after it was no better
        there, _ = found.places(int(gaps.argmin()))
        np.testing.assert_allclose(there, made["points"][index], atol=1e-6)
        far += len(found.transforms) > 6
    assert far  # some had to go back to what is valid


def test_the_original_is_the_row_that_is_moved(made):
    for index in (0, 1, 3, 4, 95):
        original = original_of(made, index)
        assert original == index // 4 * 4 and made["verdict"][original] == Verdict.ORIGINAL


def test_nothing_was_searched_for_where_nothing_was_moved(made):
    with pytest.raises(ValueError, match="row 4 is an original: nothing was searched for"):
        replayed(made, 4)
