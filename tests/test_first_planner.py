"""docs/first_planner.md followed as it is written, with smaller numbers: from a hose to a comparison."""

import re
from pathlib import Path

import pytest

from doojax.commands import call, parsed
from doojax.datasets import Dataset
from doojax.experiments.reports.prose import commands_of
from doojax.experiments.trials.record_files import load_record

PAGE = Path(__file__).parents[1] / "docs/first_planner.md"
SMALLER = (("1024", "128"), ("256", "96"), ("--epochs 60", "--epochs 4"), ("--count 12", "--count 2"))


def commands() -> list[str]:
    return [line for _, line in commands_of(PAGE.read_text().splitlines())]


def test_the_hose_is_one_hose_in_all_commands_and_the_one_of_the_data_sheet():
    names = [line.split()[1] for line in commands()]
    assert names == [
        *("collect", "collect", "inspect", "render", "train", "train", "evaluate-model"),
        *("scenes", "evaluate", "compare", "view"),
    ]
    ropes = {
        str(arguments["rope"])
        for line in commands()
        for function, arguments in parsed(line)
        if function.__name__ in ("collect", "scenes")
    }
    assert len(ropes) == 1
    (value,) = re.findall(r"# (0\.\d+)$", PAGE.read_text(), re.MULTILINE)
    assert f"bending_stiffness={value}" in ropes.pop()


@pytest.mark.slow  # two minutes
def test_the_page_smaller_ends_in_a_comparison_of_three_methods(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line in commands()[:-1]:  # but for the browser
        for old, new in SMALLER:
            line = line.replace(old, new)
        for function, arguments in parsed(line):
            call(function, arguments)
    assert len(Dataset.open("hose/free")) == 128
    for method in ("classifier", "collision_checker", "no_classifier"):
        records = [load_record(path) for path in sorted(Path("hose/trials", method).glob("*.npz"))]
        assert len(records) == 2
    assert Path("hose/trials/comparison/comparison.md").exists()
    assert Path("hose/among.png").stat().st_size > 1000
