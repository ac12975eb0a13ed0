"""scripts/bootstrap in small projects of its own: which Python it takes, what it does when interrupted."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYTHON = Path(sys.base_prefix) / "bin" / f"python3.{sys.version_info.minor}"
TOOLS = ["bash", "cat", "cksum", "dirname", "flock", "grep", "mkdir", "rm", "sleep", "touch"]

# A build backend that needs no download and, if told to, leaves its mark and never ends.
BACKEND = """
import os, pathlib, time, zipfile

def build_editable(folder, config_settings=None, metadata_directory=None):
    if os.environ.get("NEVER_END"):
        pathlib.Path("started").touch()
        time.sleep(60)
    name = "sample-1.0-py3-none-any.whl"
    with zipfile.ZipFile(pathlib.Path(folder) / name, "w") as wheel:
        wheel.writestr("sample.pth", os.getcwd())
        info = "sample-1.0.dist-info/"
        wheel.writestr(info + "METADATA", "Metadata-Version: 2.1\\nName: sample\\nVersion: 1.0\\n")
        wheel.writestr(info + "WHEEL", "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n")
        wheel.writestr(info + "RECORD", "")
    return name
"""
PROJECT = """
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]
[project]
name = "sample"
version = "1.0"
"""


def script(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def project(tmp_path):
    """A checkout with nothing to install but itself."""
    folder = tmp_path / "a project"
    (folder / "scripts").mkdir(parents=True)
    shutil.copy(ROOT / "scripts/bootstrap", folder / "scripts/bootstrap")
    (folder / "backend.py").write_text(BACKEND)
    (folder / "pyproject.toml").write_text(PROJECT)
    (folder / "requirements.lock").write_text("")
    (folder / "sample.py").write_text("print('sample works')")
    return folder


@pytest.fixture
def environment(tmp_path):
    """A machine with the usual tools and no Python; as with pyenv, python3.12 is there but does not run."""
    tools = tmp_path / "bin"
    tools.mkdir()
    for tool in TOOLS:
        if found := shutil.which(tool):
            (tools / tool).symlink_to(found)
    script(tools / "python3.12", "echo 'pyenv: python3.12: command not found' >&2; exit 127")
    script(tools / "python3", 'exit 1  # another version: the question "do you fit?" is answered by no')
    return {"PATH": str(tools), "HOME": str(tmp_path / "home")}


@pytest.fixture(scope="module")
def python(tmp_path_factory) -> str:
    """A Python that makes a virtual environment once, and then copies it: pip takes seconds to install."""
    folder = tmp_path_factory.mktemp("python")
    subprocess.run([PYTHON, "-m", "venv", folder / "made"], check=True)
    text = f"""case "$1 $2" in
  "-m venv") exec {shutil.which("cp")} -a "{folder}/made/." "$3" ;;
  *) exec "{PYTHON}" "$@" ;;
esac"""
    return str(script(folder / "python", text))


def bootstrap(project: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [project / "scripts/bootstrap"], env=environment, capture_output=True, text=True, timeout=100
    )


def runs(project: Path) -> bool:
    """Can the project be imported with its .venv, from anywhere?"""
    command = [project / ".venv/bin/python", "-c", "import sample"]
    result = subprocess.run(command, cwd="/", capture_output=True, text=True)
    return result.stdout == "sample works\n"


@pytest.mark.parametrize("place", ["variable", "path", "second on path", "pyenv", "pyenv root", "uv"])
def test_it_takes_a_python_that_runs_wherever_it_is(project, environment, tmp_path, place):
    """The Python found here answers questions and then, asked to make .venv, only says that it was chosen."""
    text = f'if [ "$1 $2" = "-m venv" ]; then echo chosen; exit 9; fi; exec "{PYTHON}" "$@"'
    places = {
        "variable": tmp_path / "some where/python",
        "path": tmp_path / "bin/python3.13",
        "second on path": tmp_path / "other/python3.12",
        "pyenv": tmp_path / "home/.pyenv/versions/3.12.1/bin/python3",
        "pyenv root": tmp_path / "pyenv/versions/3.13.0/bin/python3",
        "uv": tmp_path / "uv/cpython-3.12/bin/python3.12",
    }
    found = script(places[place], text)
    if place == "variable":
        environment["PYTHON"] = str(found)
    elif place == "second on path":
        environment["PATH"] += f":{found.parent}"
    elif place == "pyenv root":
        environment["PYENV_ROOT"] = str(tmp_path / "pyenv")
    elif place == "uv":
        script(tmp_path / "bin/uv", f'[ "$1 $2" = "python find" ] && echo "{found}"')
    result = bootstrap(project, environment)
    assert result.stdout.endswith(f"{found}\nchosen\n"), result
    assert result.returncode == 9


def test_without_a_python_it_says_what_to_install_and_leaves_nothing(project, environment):
    before = sorted(project.rglob("*"))
    result = bootstrap(project, environment | {"PYTHON": "/nowhere/python"})
    assert result.returncode == 1
    assert result.stdout == ""
    assert "PYTHON=/nowhere/python is not a Python 3.12 or 3.13" in result.stderr
    assert "doojax: needs Python 3.12 or 3.13 (with venv), and none that runs was found" in result.stderr
    assert "apt install python3.12-venv" in result.stderr
    assert "pyenv install 3.12" in result.stderr
    assert sorted(project.rglob("*")) == before


def test_it_installs_once_repairs_what_was_interrupted_and_follows_changes(project, environment, python):
    environment["PYTHON"] = python

    # Killed in the middle of the installation.
    process = subprocess.Popen(
        [project / "scripts/bootstrap"],
        env=environment | {"NEVER_END": "1"},
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60
    while not (project / "started").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert (project / "started").exists()
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not runs(project)

    # The next run starts afresh.
    (project / ".venv/left over").touch()
    result = bootstrap(project, environment)
    assert (result.returncode, result.stderr) == (0, "")
    assert "doojax: making .venv" in result.stdout and result.stdout.endswith("doojax: .venv is ready\n")
    assert runs(project)
    assert not (project / ".venv/left over").exists()

    # Nothing changed: nothing is done or said, at once, and no Python needs to be found.
    del environment["PYTHON"]
    stamp = (project / ".venv/stamp").stat().st_mtime_ns
    start = time.monotonic()
    result = bootstrap(project, environment)
    assert time.monotonic() - start < 1
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    assert (project / ".venv/stamp").stat().st_mtime_ns == stamp

    # The project file changed: installed into the same .venv.
    (project / ".venv/kept").touch()
    (project / "pyproject.toml").write_text(PROJECT + 'description = "changed"\n')
    result = bootstrap(project, environment)
    assert (result.returncode, result.stderr) == (0, "")
    assert "making .venv" not in result.stdout and "is ready" in result.stdout
    assert (project / ".venv/kept").exists()

    # The Python under .venv is gone, as after an upgrade of the system's.
    (project / ".venv/bin/python").unlink()
    (project / ".venv/bin/python").symlink_to("/nowhere/python3.12")
    result = bootstrap(project, environment | {"PYTHON": python})
    assert (result.returncode, result.stderr) == (0, "")
    assert runs(project)
    assert not (project / ".venv/kept").exists()


def test_a_failed_installation_is_said_and_done_again(project, environment, python):
    environment["PYTHON"] = python
    (project / "requirements.lock").write_text("no-such-package-of-doojax==1.0\n")
    environment |= {"PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull}
    result = bootstrap(project, environment)
    assert result.returncode != 0
    assert "no-such-package-of-doojax==1.0" in result.stderr
    assert "ready" not in result.stdout
    (project / "requirements.lock").write_text("")
    assert bootstrap(project, environment).returncode == 0
    assert runs(project)
