"""The bench on the toy task, whose physics are the same everywhere but at its wall."""

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.augmentation import augment, setting_of
from doojax.augmentation.resimulation import drawn_examples
from doojax.benchmarks.augmentation import augmentation, compared
from doojax.keys import numbered, stream
from doojax.tasks import make_task
from doojax.types import Verdict

COUNT = 48


@pytest.mark.slow
def test_accepted_augmentations_are_what_the_simulator_does_and_random_ones_are_not():
    task = make_task("toy")
    simulator = task.simulator("mujoco")
    starts, examples = drawn_examples(task, simulator, COUNT, stream(0, "starts"), stream(0, "actions"))
    setting = setting_of(task)
    found = augment(numbered(stream(0, "test"), range(COUNT)), examples, setting)
    errors = compared(task, simulator, setting, starts, examples, found)
    accepted = int((np.asarray(found.verdict) == Verdict.ACCEPTED).sum())
    assert {name: len(values) for name, values in errors.items()} == {
        "augmented": accepted,
        "original": accepted,
        "random": COUNT,
    }
    assert accepted > COUNT / 3
    assert np.quantile(errors["augmented"], 0.9) < 1e-6
    assert errors["random"].max() > 1e-3
    assert jnp.isfinite(found.centre).all()


def test_no_transitions():
    with pytest.raises(ValueError, match="transitions is 0, expected at least 1"):
        augmentation(transitions=0)
