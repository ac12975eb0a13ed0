"""scripts/demo, small: the whole story, with the Python that runs the tests in place of one set up anew."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_demo_tells_its_story_and_goes_on_when_run_again(tmp_path):
    project = tmp_path / "project"
    for name, text in (
        ("scripts/bootstrap", "#!/bin/sh\n"),
        (".venv/bin/doojax", f'#!/bin/sh\nexec "{sys.executable}" -m doojax.cli "$@"\n'),
    ):
        file = project / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        file.chmod(0o755)
    shutil.copy(ROOT / "scripts/demo", project / "scripts/demo")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for _ in range(2):
        ran = subprocess.run(
            [project / "scripts/demo", tmp_path / "out", "small"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=1200,
        )
        assert ran.returncode == 0, ran.stdout + ran.stderr
    for name in ("among.png", "among.gif", "trial.png", "trials/comparison/success.png"):
        assert (tmp_path / "out" / name).stat().st_size > 1000
    assert "That took" in ran.stdout
