"""The variational autoencoder against closed forms of its bound."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from doojax.models.vae import Vae, VaeConfig, divergence

CONFIG = VaeConfig(inputs=6, hidden=8, latent=3)
X = jnp.array([0.5, -1.0, 2.0, 0.0, 0.1, -0.3])


@pytest.fixture(scope="module")
def model():
    return Vae(CONFIG, key=jax.random.key(0))


def test_divergence_of_normals_by_hand():
    assert float(divergence(jnp.zeros(4), jnp.zeros(4))) == 0
    assert float(divergence(jnp.array([1.0, -2.0]), jnp.zeros(2))) == pytest.approx(2.5)
    wide = 0.5 * (4 - 1 - np.log(4))
    assert float(divergence(jnp.zeros(1), jnp.log(jnp.array([4.0])))) == pytest.approx(wide)


def test_the_bound_is_the_likelihood_where_nothing_is_encoded(model):
    nothing = jax.tree.map(jnp.zeros_like, eqx.filter(model, eqx.is_inexact_array))
    blank = eqx.combine(nothing, model)
    assert float(blank.loss(X, jax.random.key(1))) == pytest.approx(
        -norm.logpdf(np.asarray(X)).sum(), rel=1e-5
    )


def test_a_lower_temperature_varies_more_and_none_is_the_reconstruction(model):
    mean, log_variance = model.encoded(X)
    still = model.varied(X, jax.random.key(2), 1e9)
    np.testing.assert_allclose(still, model.decoder(mean), atol=1e-6)

    def spread_at(temperature: float) -> float:
        keys = jax.random.split(jax.random.key(3), 256)
        return float(jax.vmap(lambda key: model.varied(X, key, temperature))(keys).std(0).mean())

    spread = [spread_at(1.0), spread_at(10.0)]
    assert spread[0] > 3 * spread[1] > 0 and log_variance.shape == (3,)
