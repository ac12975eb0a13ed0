"""Importing doojax, or all of one of its packages, changes nothing and loads only what is needed."""

import json
import subprocess
import sys

import pytest

CODE = """
import importlib, json, os, pkgutil, sys
import jax
before = dict(os.environ), dict(jax.config.values)
for name in sys.argv[1:]:
    module = importlib.import_module(name)
    if module.__name__ != "doojax":
        for inner in pkgutil.walk_packages(getattr(module, "__path__", []), module.__name__ + "."):
            importlib.import_module(inner.name)
after = dict(os.environ), dict(jax.config.values)
changed = [key for old, new in zip(before, after) for key in old | new if old.get(key) != new.get(key)]
print(json.dumps([changed, sorted(name for name in sys.modules if "." not in name)]))
"""

DRAWING = {"viser", "matplotlib"}
PHYSICS = {"mujoco"}


@pytest.mark.parametrize(
    ("modules", "kept_out"),
    [
        (["doojax"], DRAWING | PHYSICS | {"equinox", "scipy", "trimesh", "zarr"}),
        # what none of several loads, all of them together do not
        (["doojax.types", "doojax.geometry", "doojax.topology"], DRAWING | PHYSICS | {"trimesh"}),
        (["doojax.simulation", "doojax.tasks", "doojax.datasets"], DRAWING),
    ],
    ids=["doojax", "geometry", "simulation"],
)
def test_an_import_sets_nothing_and_loads_only_what_is_needed(modules, kept_out):
    process = subprocess.run(
        [sys.executable, "-c", CODE, *modules], capture_output=True, text=True, timeout=120
    )
    assert process.returncode == 0, process.stderr
    (line,) = process.stdout.splitlines()  # nothing else is printed
    changed, loaded = json.loads(line)
    assert changed == []
    assert kept_out & set(loaded) == set()
    assert "jax" in loaded, "the list of modules was read"
