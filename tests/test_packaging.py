"""The package as it is published: what its wheel says and holds, and what a plain installation needs."""

import os
import subprocess
import sys
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

from doojax.optional import EXTRAS, advice, require

ROOT = Path(__file__).parents[1]
LEFT_OUT = {"viser", "matplotlib", "imageio", "PIL"}

# What follows a plain `pip install doojax`; {absent} cannot be imported, as if not installed.
FIRST_USE = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in {absent!r}:
            raise ModuleNotFoundError("No module named " + repr(name), name=name)
sys.meta_path.insert(0, Absent())
import jax, jax.numpy as jnp
import doojax.datasets, doojax.learning, doojax.models, doojax.planning, doojax.robots, doojax.topology
from doojax.tasks import make_task
simulator = make_task("rope_dragging").simulator(engine="mujoco")
states = jax.vmap(simulator.reset)(jax.random.split(jax.random.key(0), 2))
_, seen = simulator.rollout(states, jnp.full((2, 1, 1, 3), 0.01))
print(seen.states.points.shape)
from doojax.cli import main
sys.exit(main(["view", "."]))
"""


def build_wheel(folder: Path) -> Path:
    """The wheel of this checkout."""
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder],
        cwd=ROOT,
        check=True,
        capture_output=True,
        timeout=60,
    )
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build_wheel(tmp_path_factory.mktemp("wheel"))


def test_the_wheel_says_who_made_it_and_under_which_licence(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith("dist-info/METADATA")]
        about = message_from_bytes(archive.read(name))
        licence = archive.read(name.replace("METADATA", "licenses/LICENSE")).decode()
    assert about["License-Expression"] == "Apache-2.0"
    assert "Apache License" in licence
    assert about["Author"] == "the doojax authors"
    assert f"version: {about['Version']}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"({about['Version']})" in (ROOT / "CHANGELOG.md").read_text()
    assert f"version = {{{about['Version']}}}" in (ROOT / "docs/citing.md").read_text()
    needed = [line for line in about.get_all("Requires-Dist", []) if "extra ==" not in line]
    assert not [
        line for line in needed for name in ("viser", "matplotlib", "imageio", "pillow") if name in line
    ]


def test_the_wheel_holds_all_that_git_has_of_doojax_and_nothing_else(wheel):
    tracked = subprocess.run(["git", "ls-files", "doojax"], cwd=ROOT, capture_output=True, text=True)
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    if tracked.returncode == 0:
        assert set(tracked.stdout.split()) - held == set()
    assert {name.split("/")[0] for name in held} == {"doojax"}
    assert "doojax/py.typed" in held and "doojax/robots/dual_arm.xml" in held


def test_a_plain_installation_simulates_and_says_which_extra_a_viewer_needs():
    process = subprocess.run(
        [sys.executable, "-c", FIRST_USE.format(absent=LEFT_OUT)], capture_output=True, text=True, timeout=100
    )
    assert process.stdout.endswith("(2, 2, 10, 3)\n"), process.stderr
    assert process.returncode == 2
    assert "pip install 'doojax[view]'" in process.stderr


def test_an_error_names_the_extra_once_and_knows_no_extra_of_a_stranger():
    with pytest.raises(ModuleNotFoundError, match=r"^[^\[]+ no_such_package$"):
        require("json", "no_such_package")
    for module, extra in EXTRAS.items():
        error = ModuleNotFoundError(f"No module named {module!r}", name=f"{module}.inner")
        said = advice(error)
        assert said.endswith(f": pip install 'doojax[{extra}]'")
        assert advice(ModuleNotFoundError(said, name=module)) == said


@pytest.mark.slow
@pytest.mark.parametrize("minor", [12, 13])
def test_the_wheel_works_in_an_environment_of_its_own(wheel, tmp_path, minor):
    """Downloads half a gigabyte, unless pip has it."""
    roots = [Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions", Path("/usr")]
    pythons = [found for root in roots for found in sorted(root.glob(f"**/bin/python3.{minor}"))]
    if not pythons:
        pytest.skip(f"there is no Python 3.{minor}")
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([pythons[0], "-m", "venv", tmp_path / "venv"], check=True, env=own)
    python = tmp_path / "venv/bin/python"
    subprocess.run([python, "-m", "pip", "install", "-q", wheel], check=True, env=own, timeout=800)
    code = FIRST_USE.format(absent=set())
    process = subprocess.run(
        [python, "-c", code], env=own, cwd=tmp_path, capture_output=True, text=True, timeout=200
    )
    assert process.stdout.endswith("(2, 2, 10, 3)\n"), process.stderr
    assert "pip install 'doojax[view]'" in process.stderr
    began = "import time; at = time.process_time(); import doojax; print(time.process_time() - at)"
    seconds = subprocess.run(
        [python, "-c", began], env=own, cwd=tmp_path, capture_output=True, text=True
    ).stdout
    assert float(seconds) < 1.5
    listed = subprocess.run([python, "-m", "pip", "list"], env=own, capture_output=True, text=True).stdout
    assert not [name for name in ("viser", "matplotlib", "imageio") if name in listed]
