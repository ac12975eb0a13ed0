"""Settings that every test shares."""

from pathlib import Path

import jax
import pytest

HERE = Path(__file__).parent
# Two workers take one folder at a time: what one test compiles or opens serves its neighbours. One that
# takes long and begins last would keep the other worker waiting.
DEAREST = (
    "viewer",
    "experiments/trials",
    "planning",
    "simulation",
    "tasks",
    "learning",
    "models",
    "geometry",
)
DEAREST += ("experiments/online", "datasets", "topology", "augmentation", "robots", "benchmarks")


def group_of(item: pytest.Item) -> str:
    """A test's folder, or its file if that is in no folder."""
    folder = item.path.parent.relative_to(HERE).as_posix()
    return item.path.stem if folder == "." else folder


@pytest.hookimpl(tryfirst=True)  # xdist reads the marks
def pytest_collection_modifyitems(items):
    """What belongs together is run by one worker, the dearest first."""
    for item in items:
        item.add_marker(pytest.mark.xdist_group(group_of(item)))
    places = {name: place for place, name in enumerate(DEAREST)}
    items.sort(key=lambda item: places.get(group_of(item), len(places)))  # stable: a file stays together


@pytest.fixture(autouse=True, scope="session")
def strict_keys():
    """Reusing a random key is an error anywhere in doojax."""
    jax.config.update("jax_debug_key_reuse", True)
    yield
