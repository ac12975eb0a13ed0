"""docs/own_things.md as a stranger follows it: a hose and two meshes in a package, and evaluated plans."""

import re
import tomllib
from pathlib import Path

import pytest

from doojax.commands import call, parsed
from doojax.experiments.reports.prose import commands_of
from doojax.experiments.trials.record_files import load_record

PAGE = Path(__file__).parents[1] / "docs/own_things.md"


def code(language: str) -> list[str]:
    """The page's blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """What the page has its reader type."""
    return [line for _, line in commands_of(PAGE.read_text().splitlines())]


@pytest.fixture
def package(tmp_path, monkeypatch):
    """The page's module and entry point, as pip installs them."""
    *module, _ = code("python")  # the last block is for a notebook
    (tmp_path / "my_hose.py").write_text("\n".join(module))
    (entry,) = (tomllib.loads(block)["project"]["entry-points"] for block in code("toml"))
    about = tmp_path / "my_hose-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-hose\nVersion: 1.0\n")
    lines = [
        f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()) for group, points in entry.items()
    ]
    (about / "entry_points.txt").write_text("".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_command_of_the_page_knows_what_it_is_told():
    assert [line.split()[1] for line in commands()] == ["import", "scenes", "evaluate", "compare"]
    assert all(parsed(line) for line in commands())


@pytest.mark.slow
def test_the_page_word_for_word_ends_in_plans_that_reach_their_goals(package):
    for line in commands()[1:]:  # after the one that needs a file of the reader's
        for function, arguments in parsed(line):
            call(function, arguments)
    records = [load_record(path) for path in sorted((package / "trials/collision_checker").glob("*.npz"))]
    assert len(records) == 4
    reached = [record for record in records if record.about["final_error_m"] < 0.05]
    assert len(reached) >= 2
    assert all(len(record.plans[0].path) > 1 for record in reached)
    assert (package / "trials/comparison").is_dir()
