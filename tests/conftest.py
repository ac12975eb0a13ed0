"""Settings that every test shares."""

import jax
import pytest

# Two workers take one file at a time: one that takes long and begins last would keep the other waiting.
DEAREST = {f"test_{name}" for name in ("derivatives", "contract", "evaluate", "trial", "documents", "page")}
DEAREST |= {f"test_{name}" for name in ("other_tasks", "rrt", "recovery", "scenes", "fuzz", "seen", "train")}


def pytest_collection_modifyitems(items):
    """The dearest files come first."""
    items.sort(key=lambda item: item.path.stem not in DEAREST)  # stable: tests of a file stay together


@pytest.fixture(autouse=True, scope="session")
def strict_keys():
    """Reusing a random key is an error anywhere in doojax."""
    jax.config.update("jax_debug_key_reuse", True)
    yield
