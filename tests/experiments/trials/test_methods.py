"""Which models a method plans with: those that lie beside, or in the folder of its name."""

from dataclasses import asdict

import pytest

from doojax.experiments.trials.methods import find_models, needed_models
from doojax.learning.checkpoints import Header, save_model
from doojax.models.builders import BUILDERS
from doojax.models.pouring import PouringConfig, PouringJudgeConfig

CONFIGS = {
    "dynamics": {**asdict(PouringConfig(8, 1)), "members": 1},
    "deviation": asdict(PouringJudgeConfig(8, 1)),
}


def written(path, kind):
    path.parent.mkdir(parents=True)
    save_model(path, Header(kind, "watering_2d", CONFIGS[kind], {}), BUILDERS[kind](CONFIGS[kind]))


@pytest.fixture
def folder(tmp_path):
    """Models as `doojax watering-study` leaves them."""
    for name in ("source/dynamics", "focus/dynamics", "focus/deviation", "all_data/dynamics"):
        written(tmp_path / name / "model.eqx", name.split("/")[1])
    return tmp_path


def test_a_method_finds_the_models_in_the_folder_of_its_adaptation(folder):
    found = find_models(folder, "watering_2d")
    focus = {
        "deviation": folder / "focus/deviation/model.eqx",
        "dynamics": folder / "focus/dynamics/model.eqx",
    }
    assert needed_models("focus", found) == focus
    assert needed_models("all_data_no_mde", found) == {"dynamics": folder / "all_data/dynamics/model.eqx"}
    assert needed_models("no_adaptation", found) == {"dynamics": folder / "source/dynamics/model.eqx"}
    assert needed_models("oracle", found) == {}


def test_what_is_missing_is_named_with_its_folder(folder):
    with pytest.raises(ValueError, match="'all_data' needs models of kind all_data/deviation; there are: "):
        needed_models("all_data", find_models(folder, "watering_2d"))
    with pytest.raises(ValueError, match="'no_classifier' needs models of kind dynamics"):
        needed_models("no_classifier", find_models(folder, "watering_2d"))
    with pytest.raises(ValueError, match=r"'no_adaptation' needs models of kind source/dynamics; .* none"):
        needed_models("no_adaptation", {})


def test_two_models_of_a_kind_side_by_side_are_refused(folder):
    for name in ("one", "two"):
        written(folder / name / "model.eqx", "dynamics")
    with pytest.raises(ValueError, match="are both of kind 'dynamics': keep one"):
        find_models(folder, "watering_2d")
