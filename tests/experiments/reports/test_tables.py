"""The tables of README and docs, made from summary files."""

from pathlib import Path

import pytest

from doojax.experiments.reports.summary import row, write_summary
from doojax.experiments.reports.tables import figure, report

ROOT = Path(__file__).parents[3]

COMMAND = "doojax bench rollouts --task 'toy | b'"
README = """# A project

<!-- results:simulation:steps_per_s,compile_s -->
whatever stood here
<!-- /results -->

The end, with <!-- results:simulation:steps_per_s --> inside a line.
"""


@pytest.fixture
def project(tmp_path):
    """A folder with results, a README and a page of docs."""
    rows = [
        row("steps_per_s", {"task": "toy", "batch": 64}, 12345.6, "1/s", low=12000.0, high=13000.0, n=5),
        row("steps_per_s", {"task": "toy", "batch": 1024}, 98765.4, "1/s"),
        row("compile_s", {"task": "toy"}, 2.345, "s"),
    ]
    path = tmp_path / "results/simulation/summary.json"
    write_summary(path, command=COMMAND, seed=7, rows=rows)
    (tmp_path / "README.md").write_text(README)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/speed.md").write_text("<!-- results:simulation:compile_s -->\n<!-- /results -->\n")
    return tmp_path


def test_tables_are_made_from_the_summaries(project, capsys):
    report(project / "results")
    lines = (project / "README.md").read_text().splitlines()
    assert lines[:8] == [
        "# A project",
        "",
        "<!-- results:simulation:steps_per_s,compile_s -->",
        "| task | batch | steps_per_s (1/s) | compile_s (s) |",
        "| :-- | :-- | --: | --: |",
        "| toy |  |  | 2.35 |",
        "| toy | 64 | 12,346 (12,000 to 13,000, n = 5) |  |",
        "| toy | 1024 | 98,765 |  |",
    ]
    assert lines[8] == ""
    assert lines[9].startswith(f"- `{COMMAND}`, seed 7, 20")
    assert lines[9].endswith("([figures and versions](results/simulation/summary.json))")
    assert lines[10:] == README.splitlines()[4:]
    assert "](../results/simulation/summary.json)" in (project / "docs/speed.md").read_text()
    assert capsys.readouterr().out == "tables written anew: README.md, speed.md\n"


def test_check_changes_nothing_and_fails_only_on_stale_tables(project, capsys):
    with pytest.raises(ValueError, match=r"figures of README.md, speed.md are stale; .* doojax report"):
        report(project / "results", check=True)
    assert (project / "README.md").read_text() == README
    report(project / "results")
    report(project / "results", check=True)
    assert "every table is up to date" in capsys.readouterr().out
    changed = row("compile_s", {"task": "toy"}, 3.0, "s")
    path = project / "results/simulation/summary.json"
    write_summary(path, command="doojax bench rollouts", seed=None, rows=[changed])
    with pytest.raises(ValueError, match=r"README\.md, speed\.md are stale"):
        report(project / "results", check=True)


def test_one_document_alone(project):
    report(project / "results", readme=project / "docs/speed.md")
    assert (project / "README.md").read_text() == README
    assert "2.35" in (project / "docs/speed.md").read_text()


def test_each_run_of_the_shown_rows_is_named(project):
    again = [row("steps_per_s", {"task": "toy", "batch": 64}, 2.0, "1/s")]
    write_summary(project / "results/simulation/summary.json", command="later", seed=None, rows=again)
    report(project / "results", readme=project / "README.md")
    made_by = [line for line in (project / "README.md").read_text().splitlines() if line.startswith("- ")]
    assert [line.split(", 20")[0] for line in made_by] == [f"- `{COMMAND}`, seed 7", "- `later`"]


COMPILE = "<!-- results:simulation:compile_s -->\n"


@pytest.mark.parametrize(
    ("text", "error", "complaint"),
    [
        (
            COMPILE.replace("_s", ""),
            ValueError,
            "README.md:1: .* no metric 'compile'; it has: compile_s, steps",
        ),
        ("\n" + COMPILE.replace("simulation", "moon"), FileNotFoundError, "README.md:2: .*moon"),
        ("<!-- results simulation -->\n", ValueError, "README.md:1: .* should read <!-- results:AREA:METRIC"),
        (COMPILE + "text\n", ValueError, "README.md:1: this table is not closed"),
        (COMPILE * 2, ValueError, "README.md:2: the table of line 1 is not closed"),
        ("<!-- /results -->\n", ValueError, "README.md:1: .* closes no table"),
    ],
)
def test_a_wrong_marker_is_named_and_nothing_is_written(project, text, error, complaint):
    (project / "README.md").write_text(text)
    with pytest.raises(error, match=complaint):
        report(project / "results")
    assert (project / "README.md").read_text() == text


def test_a_missing_folder_or_document_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no folder of results .*nowhere"):
        report(tmp_path / "nowhere")
    (tmp_path / "results").mkdir()
    report(tmp_path / "results")  # no documents, nothing to do
    with pytest.raises(FileNotFoundError, match=r"page\.md"):
        report(tmp_path / "results", readme=tmp_path / "page.md")


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1.0, "1"), (0.123456, "0.123"), (999.6, "1,000"), (1234.5, "1,234"), (1.5e-5, "1.5e-05")],
)
def test_figures_have_three_digits_or_all_before_the_point(value, text):
    assert figure(row("m", {}, value, "")) == text


def test_a_run_without_a_complete_command_says_so(project):
    path = project / "results/simulation/summary.json"
    incomplete = "doojax evaluate toy --methods oracle"
    write_summary(path, command=incomplete, seed=None, rows=[row("compile_s", {"task": "toy"}, 3.0, "s")])
    report(project / "results")
    with pytest.raises(ValueError, match=r"summary.json: 'doojax evaluate toy .* is not understood: .*--out"):
        report(project / "results", check=True)
    text = path.read_text()
    path.write_text(text.replace('"note": ""}\n', '"note": "--out is missing"}\n'))
    assert path.read_text() != text
    report(project / "results")
    report(project / "results", check=True)
    assert f"- `{incomplete}` (--out is missing), 20" in (project / "README.md").read_text()


def test_the_tables_of_this_project_are_up_to_date():
    report(ROOT / "results", check=True)
