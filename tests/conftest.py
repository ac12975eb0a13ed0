"""Settings that every test shares."""

import jax
import pytest


@pytest.fixture(autouse=True, scope="session")
def strict_keys():
    """Reusing a random key is an error anywhere in doojax."""
    jax.config.update("jax_debug_key_reuse", True)
    yield
