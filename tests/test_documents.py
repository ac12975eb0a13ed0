"""README.md and docs: commands are read, Python runs, links lead somewhere, and results/ stays as it is."""

import contextlib
import doctest
import importlib.util
import io
import json
import re
from collections.abc import Iterator
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
LONG = {"environments.md", "robots.md", "planning.md", "own_things.md"}  # compile for ten seconds and more
PAGES = [
    pytest.param(path, marks=pytest.mark.slow if path.name in LONG else (), id=path.name)
    for path in DOCUMENTS
    if "```python" in path.read_text(encoding="utf-8")
]


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


@pytest.mark.parametrize("document", PAGES)
def test_a_pages_python_runs(document):
    run_page(document, SMALLER.get(document.name, ()))


def shown() -> list[Path]:
    """All that the site shows, and so a page may link to."""
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "docs/site/pages.py")
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    return pages.shown()


def unexecuted(text: str) -> list[str]:
    """The first lines of blocks that look like Python to a reader and not to this file."""
    fences = re.findall(
        r"^[ >]*(?:```+|~~~+) *\{?\.?(?:py|ipython|pycon).*$", text, re.MULTILINE | re.IGNORECASE
    )
    return [fence for fence in fences if fence != "```python"]


def test_no_python_escapes():
    for page in shown():
        if page.suffix == ".md":
            text = page.read_text(encoding="utf-8")
            assert not unexecuted(text), page
            assert page in DOCUMENTS or "```python" not in text, page
    text = "```python\nx\n```\n  ```python\n```py\n~~~ python\n``` {.python}\n```toml\n"
    assert [fence.strip() for fence in unexecuted(text)] == [
        "```python",
        "```py",
        "~~~ python",
        "``` {.python}",
    ]


def anchors(text: str) -> set[str]:
    """Of a page's headings, as code hosts and the site make them."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def link_faults(page: Path, known: set[Path]) -> Iterator[str]:
    """Links of a page that lead to nothing that the site has, or to no heading there."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]*)", re.sub(r"`[^`\n]*`", "", text)):
        if link.startswith(("https://", "http://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if target not in known:
            yield f"{page.name}: the site has no {link}"
        elif anchor and anchor not in anchors(target.read_text(encoding="utf-8")):
            yield f"{page.name}: {link} names no heading"


def test_links_within_the_documents_lead_somewhere():
    known = set(shown())
    pages = [page for page in known if page.suffix == ".md"]
    assert set(DOCUMENTS) <= known
    assert [fault for page in pages for fault in link_faults(page, known)] == []


def test_a_link_that_leads_nowhere_is_found(tmp_path):
    page, other = tmp_path / "page.md", tmp_path / "other.md"
    page.write_text(
        "# Here\n[a](other.md#to-be-or-not) [b](#here) [c](https://x.org/y) `[d](e)`\n```\n[f](g)\n```\n"
    )
    other.write_text("## To be, or not?\n")
    assert list(link_faults(page, {page, other})) == []
    assert list(link_faults(page, {page})) == ["page.md: the site has no other.md#to-be-or-not"]
    other.write_text("# To be\n```\n# to be or not\n```\n")
    assert list(link_faults(page, {page, other})) == ["page.md: other.md#to-be-or-not names no heading"]


def cells() -> list[str]:
    """The code of the notebook."""
    notebook = json.loads((ROOT / "docs/notebook.ipynb").read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


def test_the_notebook_holds_code_alone_and_imports_what_there_is():
    notebook = json.loads((ROOT / "docs/notebook.ipynb").read_text(encoding="utf-8"))
    assert not any(cell.get("outputs") for cell in notebook["cells"])
    names: dict[str, object] = {}
    for number, cell in enumerate(cells()):
        compile(cell, f"cell {number}", "exec")
        exec("\n".join(re.findall(r"^(?:from|import) .*$", cell, re.MULTILINE)), names)
    assert {"make_task", "search", "signed_distance"} <= set(names)


@pytest.mark.slow  # a minute
def test_the_notebook_runs_and_its_plan_gets_near(monkeypatch, capsys):
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, object] = {}
    for number, cell in enumerate(cells()):
        exec(compile(cell, f"cell {number}", "exec"), names)
    assert capsys.readouterr().out.count("solved") == 1
    assert names["gap"][0] < 1e-3, "prediction and execution begin with the same rope"
    assert names["reached"] < 0.1


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
