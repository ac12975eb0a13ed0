"""README.md and docs/*.md: their commands are read, their Python runs, nothing of it changes results/."""

import contextlib
import doctest
import io
import re
from pathlib import Path

import pytest

from doojax.commands import parsed
from doojax.experiments.reports.prose import command_faults, commands_of

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SMALLER = {  # what makes a page's Python cheap enough to run here; nothing else is changed
    "README.md": (("128", "2"), ('engine="mjx"', 'engine="mujoco"')),
    "planning.md": (("extensions=4096", "extensions=256"),),
}
PAGES = [path for path in DOCUMENTS if "```python" in path.read_text(encoding="utf-8")]


def blocks(document: Path) -> list[str]:
    """The Python of a page."""
    return re.findall(
        r"^```python\n(.*?)^```", document.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def run_page(document: Path, changes: tuple[tuple[str, str], ...]) -> None:
    """Run a page's Python, each block after those above it; what a `print(...)  # ...` says must come out."""
    names: dict[str, object] = {}
    for block in blocks(document):
        for old, new in changes:
            assert old in block, f"{document.name} no longer has {old}: it may run as it is"
            block = block.replace(old, new)
        if block.startswith(">>>"):
            test = doctest.DocTestParser().get_doctest(block, names, document.name, str(document), 0)
            result = doctest.DocTestRunner().run(test, clear_globs=False)
            names.update(test.globs)
            assert result.failed == 0
            continue
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            exec(compile(block, str(document), "exec"), names)
        expected = re.findall(r"^print\(.*\)  # (.*)$", block, re.MULTILINE)
        for line, text in zip(said.getvalue().splitlines(), expected, strict=False):
            assert text.split(", metres")[0] in line


@pytest.mark.parametrize("document", PAGES, ids=lambda path: path.name)
def test_a_pages_python_runs(document):
    run_page(document, SMALLER.get(document.name, ()))


@pytest.mark.slow
def test_the_readmes_python_runs_as_it_stands():
    run_page(ROOT / "README.md", ())


def test_every_command_is_understood():
    assert sum(len(list(commands_of(path.read_text().splitlines()))) for path in DOCUMENTS) > 15
    assert list(command_faults(DOCUMENTS, ROOT / "results")) == []


def test_no_command_that_a_reader_types_writes_into_the_published_results():
    for document in DOCUMENTS:
        for number, command in commands_of(document.read_text(encoding="utf-8").splitlines()):
            for function, arguments in parsed(command):
                if function.__name__ == "report":
                    continue
                written = {name: value for name, value in arguments.items() if isinstance(value, Path)}
                for name, path in written.items():
                    where = f"{document.name}:{number}: --{name}"
                    assert not path.resolve().is_relative_to(ROOT / "results"), where
