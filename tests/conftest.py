"""Settings that every test shares."""

import jax
import pytest

# Two workers take one file at a time: one that takes minutes and begins last would keep the other waiting.
DEAREST = ("test_derivatives", "test_kill_resume", "test_contract", "test_page", "test_train", "test_trial")


def pytest_collection_modifyitems(items):
    """The dearest files come first."""
    items.sort(key=lambda item: item.path.stem not in DEAREST)  # stable: tests of a file stay together


@pytest.fixture(autouse=True, scope="session")
def strict_keys():
    """Reusing a random key is an error anywhere in doojax."""
    jax.config.update("jax_debug_key_reuse", True)
    yield
