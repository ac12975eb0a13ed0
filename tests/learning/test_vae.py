"""Autoencoders of pushing: each learns from its own trajectories, and gives trajectories like them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.keys import generator
from doojax.learning.fit import FitConfig, fit, member
from doojax.learning.pushing import PushingData
from doojax.learning.vae import VaeProblem, size_of, varied
from doojax.models.vae import VaeConfig

OWN, STATES, BODIES = 8, 4, 3


def data(seed: int, count: int, middle: float) -> PushingData:
    places = generator(seed, "places").normal(middle, 0.01, (count, STATES, BODIES, 2))
    places = jnp.asarray(places, jnp.float32)
    return PushingData(places, places[:, 1:] - places[:, :-1])


@pytest.fixture(scope="module")
def sets():
    return [data(0, OWN, 0.05), data(1, OWN, -0.05)]


@pytest.fixture(scope="module")
def learned(sets):
    train = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *sets)
    config = VaeConfig(size_of(train), 32, 8)
    problem = VaeProblem(train, train, jnp.array(0), config, 50)
    members = (jnp.array([0, OWN]), jnp.array([OWN, OWN]))
    losses = []
    settings = FitConfig(epochs=4, batch_size=8, members=2, keep="last")
    models = fit(
        problem,
        settings,
        seed=0,
        members=members,
        report=lambda number, epochs, metrics: losses.append(metrics["train_loss"]),
    )
    return models, np.array(losses)


@pytest.mark.slow  # the bound itself is in tests/models/test_vae.py
def test_the_bound_rises(learned):
    _, losses = learned
    assert (losses[-1] < losses[0] - 5).all()


@pytest.mark.slow
def test_each_varies_what_it_learned_from(learned, sets):
    models, _ = learned
    for number, own in enumerate(sets):
        made = varied(member(models, number), own, jax.random.split(jax.random.key(0), OWN))
        assert made.places.shape == own.places.shape and made.moves.shape == own.moves.shape
        near, far = (float(jnp.abs(made.places - one).mean()) for one in (0.05, -0.05))
        assert (near < far) == (number == 0) and min(near, far) < 0.03
