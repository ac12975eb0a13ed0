"""The study of augmentation: what each method makes of a set, and a whole small one, killed and resumed."""

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.augmentation.objectives import Weights
from doojax.experiments.sweeps import augmentation
from doojax.experiments.sweeps.augmentation import augmentation_study
from doojax.experiments.sweeps.pushing_sets import MOVE_NOISE, PLACE_NOISE, PROJECTED, moved_whole, noisy
from doojax.keys import stream
from doojax.learning.pushing import PushingData


def test_noise_is_as_large_as_the_released_codes():
    still = PushingData(jnp.zeros((50, 50, 10, 2)), jnp.zeros((50, 49, 10, 2)))
    made = noisy(still, stream(0, "test"))
    assert float(made.places.std()) == pytest.approx(PLACE_NOISE, rel=0.02)
    assert float(made.moves.std()) == pytest.approx(MOVE_NOISE, rel=0.02)


def test_a_whole_scene_is_moved_rigidly():
    places = jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, (40, 5, 10, 2)), jnp.float32)
    data = PushingData(places, places[:, 1:] - places[:, :-1])
    made = moved_whole(data, stream(0, "test"))
    gaps = [np.linalg.norm(one[:, :, :, None] - one[:, :, None], axis=-1) for one in (made.places, places)]
    np.testing.assert_allclose(*gaps, atol=1e-6)  # whatever pushes whatever does so as before
    np.testing.assert_allclose(made.places[:, 1:] - made.places[:, :-1], made.moves, atol=1e-6)
    way = made.places[:, 0, 1] - made.places[:, 0, 0]
    before = places[:, 0, 1] - places[:, 0, 0]
    angle = np.angle(np.asarray((way[:, 0] + 1j * way[:, 1]) / (before[:, 0] + 1j * before[:, 1])))
    assert angle.min() < -2.5 and angle.max() > 2.5 and abs(angle.mean()) < 1


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
