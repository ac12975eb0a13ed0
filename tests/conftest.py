"""Settings that every test shares."""

from pathlib import Path

import jax
import pytest
from jax.experimental.key_reuse import _core as key_reuse
from xdist.scheduler import LoadScopeScheduling

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


def folder_of(nodeid: str) -> str:
    """Of a test, below here; its file if that is in no folder."""
    file = Path(nodeid.split("::")[0]).relative_to("tests")
    return file.stem if file.parent == Path() else file.parent.as_posix()


class ByFolder(LoadScopeScheduling):
    """Whole folders for a worker; `xdist_group` marks do nothing with pytest 9.2 and xdist 3.8, silently."""

    def _split_scope(self, nodeid: str) -> str:
        return folder_of(nodeid)


def pytest_xdist_make_scheduler(config, log):
    return ByFolder(config, log)


def pytest_collection_modifyitems(items):
    """The dearest folders first."""
    places = {name: place for place, name in enumerate(DEAREST)}
    items.sort(key=lambda item: places.get(folder_of(item.nodeid), len(places)))  # stable: files stay whole


# Operations that may reuse a key without being given one.
MAKE_KEYS = ("jit", "scan", "while", "cond", "random_wrap", "random_seed")


@pytest.fixture(autouse=True, scope="session")
def strict_keys():
    """Reusing a random key is an error anywhere in doojax.

    JAX traces an operation outside of `jit` each time it runs, to see what becomes of keys. Those that are
    given none need no look: that is a tenth of the tests' time.
    """
    checked = key_reuse.call_impl_with_key_reuse_checks

    def checked_if_needed(primitive, run, *arguments, **parameters):
        if primitive.name in MAKE_KEYS or any(map(is_key, arguments)):
            return checked(primitive, run, *arguments, **parameters)
        return run(*arguments, **parameters)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(key_reuse, "call_impl_with_key_reuse_checks", checked_if_needed)
        jax.config.update("jax_debug_key_reuse", True)
        yield


def is_key(value) -> bool:
    return hasattr(value, "dtype") and jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key)
