"""The study of augmentation: what each method makes of a set, and a whole small one, killed and resumed."""

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.augmentation.objectives import Weights
from doojax.experiments.sweeps import augmentation
from doojax.experiments.sweeps.augmentation import augmentation_study
from doojax.experiments.sweeps.pushing_sets import MOVE_NOISE, PLACE_NOISE, PROJECTED, noisy
from doojax.keys import stream
from doojax.learning.pushing import PushingData


def test_noise_is_as_large_as_the_released_codes():
    still = PushingData(jnp.zeros((50, 50, 10, 2)), jnp.zeros((50, 49, 10, 2)))
    made = noisy(still, stream(0, "test"))
    assert float(made.places.std()) == pytest.approx(PLACE_NOISE, rel=0.02)
    assert float(made.moves.std()) == pytest.approx(MOVE_NOISE, rel=0.02)


def test_an_ablation_leaves_one_gradient_out():
    usual = Weights()
    for name, weights in PROJECTED.items():
        differs = [one for one in vars(usual) if getattr(usual, one) != getattr(weights, one)]
        assert differs == [] if name == "augmentation" else differs == [name.removeprefix("no_")]
    with pytest.raises(ValueError, match=r"the weight box is -1\.0, expected at least 0"):
        Weights(box=-1.0)


def test_unknown_methods_are_named(tmp_path):
    with pytest.raises(ValueError, match="expected some of none, augmentation, no_occupancy"):
        augmentation_study(out=tmp_path / "study", methods=("none", "gan"))
    assert not (tmp_path / "study").exists()


@pytest.mark.slow
def test_a_study_that_was_killed_goes_on_to_the_same_figures(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(augmentation, "VALIDATION", 2)
    monkeypatch.setattr(augmentation, "TEST", 2)

    def study(folder: str) -> str:
        augmentation_study(
            out=tmp_path / folder,
            methods=("none", "augmentation", "vae"),
            seeds=2,
            trajectories=3,
            copies=2,
            epochs=2,
            json=True,
        )
        return capsys.readouterr().out

    whole = study("whole")
    with monkeypatch.context() as broken:

        def killed(*arguments, **options):
            raise KeyboardInterrupt

        broken.setattr(augmentation, "measured", killed)
        with pytest.raises(KeyboardInterrupt):
            study("resumed")
    assert study("resumed") == whole
    assert '"vae"' in whole and np.char.count(whole, "position_error_m") > 3
