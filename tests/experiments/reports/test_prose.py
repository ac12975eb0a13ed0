"""Figures and commands in the prose of documents."""

import pytest

from doojax.experiments.reports.prose import command_faults, commands_of, with_figures
from doojax.experiments.reports.summary import row, write_summary

MARK = "<!-- row:planning:{} task=toy method=a -->{}<!-- /row -->"


@pytest.fixture
def results(tmp_path):
    toy = {"task": "toy", "method": "a"}
    rows = [
        row("success_rate", toy, 0.96667, "", 0.9, 0.99, 150),
        row("success_rate", toy | {"start": "caught"}, 0.5, ""),
        row("error_m", toy, 0.02345, "m"),
        row("difference", toy, -7.26, ""),
        row("steps_per_s", {"task": "toy", "batch": 64, "contact": True}, 12345.6, "1/s"),
    ]
    path = tmp_path / "planning" / "summary.json"
    write_summary(path, command="doojax bench planner", seed=0, rows=rows)
    return tmp_path


def written(line, results):
    (new,) = with_figures([line], results, results / "README.md")
    return new


@pytest.mark.parametrize(
    ("metric", "old", "new"),
    [
        ("success_rate", "1 %", "97 %"),
        ("success_rate", "1.0 %", "96.7 %"),
        ("success_rate", "0.50", "0.97"),
        ("success_rate.n", "3", "150"),
        ("success_rate.low", "0%", "90%"),
        ("error_m", "9.9 cm", "2.3 cm"),
        ("error_m", "9.9 mm", "23.4 mm"),
        ("difference", "1.0", "-7.3"),
        ("difference", "-1", "-7"),
    ],
)
def test_a_figure_is_that_of_its_row_as_precise_as_it_was(results, metric, old, new):
    before, after = (f"So {MARK.format(metric, text)} of them." for text in (old, new))
    assert written(before, results) == after
    assert written(after, results) == after


def test_tags_may_be_numbers_and_truths(results):
    mark = "<!-- row:planning:steps_per_s batch=64 contact=True task=toy -->{}<!-- /row --> steps a second"
    assert written(mark.format("1"), results) == mark.format("12,346")


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("It gets there in 96.7 % of trials.", "README.md:1: '96.7 %' is in no row: put it between"),
        ("It is six times faster.", "'six times' is in no row"),
        ("It takes 3.5 ms.", "'3.5 ms' is in no row"),
        ("It makes 9,900 toy extensions a second.", "'9,900 toy extensions a second' is in no row"),
        (MARK.format("success", "1 %"), "no row is success of .*; there are: none of this metric"),
        (MARK.format("success_rate", "1 %").replace("method=a ", ""), "there are: {'task': 'toy', 'method'"),
        (MARK.format("success_rate", "many"), "'many' should be a number"),
        (MARK.format("success_rate", "1 cm"), "success_rate is in '' and cannot be shown in cm"),
        (MARK.format("error_m.low", "1 cm"), "error_m .* has no low"),
        ("<!-- row:planning:success_rate -->97 %", "a mark should read"),
    ],
)
def test_a_figure_without_a_row_is_refused(results, line, complaint):
    with pytest.raises(ValueError, match=complaint):
        written(line, results)


@pytest.mark.parametrize(
    "line",
    [
        "delta is the <!-- given -->90 %<!-- /given --> quantile",
        "`--share 5 %`, [a link](page%20of%205%.md), 64 lanes, version 3.12, chapter 2",
        "| a table | 3 % |",
    ],
)
def test_what_is_not_measured_is_left_alone(results, line):
    assert written(line, results) == line


def test_marks_in_a_table_are_filled_in_and_its_other_figures_left_alone(results):
    mark = "<!-- row:planning:success_rate task=toy method=a -->{}<!-- /row -->"
    assert written(f"| classifier | {mark.format('1 %')} | 12 % |", results) == (
        f"| classifier | {mark.format('97 %')} | 12 % |"
    )


def test_code_blocks_are_no_prose(results):
    lines = ["```", "success 96 %", "```"]
    assert list(with_figures(lines, results, results)) == lines
    with pytest.raises(ValueError, match=r":4: '96 %'"):
        list(with_figures([*lines, "96 %"], results, results))


def test_commands_in_documents_are_read(results, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "`doojax vew x`, `doojax train ...`, `doojax COMMAND --help`\n```\n"
        "doojax plan toy --seed 4      # a comment\n$ doojax plan toy --sed 4\nnot doojax at all\n```\n"
    )
    commands = list(commands_of(page.read_text().splitlines()))
    assert commands == [(3, "doojax plan toy --seed 4"), (4, "doojax plan toy --sed 4")]
    first, second = command_faults([page], results)
    assert "page.md:4: 'doojax plan toy --sed 4' is not understood" in first
    assert "page.md:1: there is no command doojax vew" in second
