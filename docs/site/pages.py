"""What the site has beside its style: README, docs, results as they lie here, and pages made from the code.

A hook of mkdocs. Pages keep their places, so that a link is right in the repository and on the site.
"""

import ast
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))  # the commands are read from this checkout

from doojax.commands import COMMANDS, Commands  # noqa: E402

SHOWN = (".md", ".png", ".gif", ".json", ".csv", ".ipynb")
ROOTS = ("README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE")
COMMENT = re.compile(r"<!--.*?-->")
TAGS = re.compile(r"(?<=\d),(?=[a-z_]+=)")  # of a rope in a table: no space to break a line at
ABOUT_COMMANDS = (
    "`doojax COMMAND --help` explains the options of one; here each links to the function behind it, whose "
    "arguments are those options."
)


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add what lies outside of the site's own folder, and what is made."""
    for path in shown():
        files.append(File.generated(config, str(path.relative_to(ROOT)), abs_src_path=str(path)))
    for name, text in made().items():
        files.append(File.generated(config, name, content=text))


def on_config(config: MkDocsConfig) -> None:
    """List the packages under Reference."""
    (reference,) = (entry["Reference"] for entry in config.nav if "Reference" in entry)
    reference += [{name: f"reference/{name}.md"} for name in packages()]


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """A page as Python-Markdown wants it; tables of all trials need room, and are nothing to search."""
    if page.file.src_uri.startswith("results/"):
        page.meta |= {"search": {"exclude": True}, "hide": ["toc"]}
    return "\n".join(plain(markdown.splitlines()))


def shown() -> list[Path]:
    """The files that the site shows as they are."""
    found = [ROOT / name for name in ROOTS]
    found += sorted((ROOT / "docs").glob("*.md")) + sorted((ROOT / "docs").glob("*.ipynb"))
    found += sorted((ROOT / "docs/figures").glob("*.png"))
    return found + [path for path in sorted((ROOT / "results").rglob("*")) if path.suffix in SHOWN]


def plain(lines: list[str]) -> Iterator[str]:
    """Without marks of figures, which would end paragraphs; lists nested by four spaces; narrower tables."""
    fenced = False
    for line in lines:
        fence = line.lstrip().startswith("```")
        fenced ^= fence
        if fenced or fence:
            yield line
        else:
            bare = COMMENT.sub("", line)
            bare = TAGS.sub(", ", bare) if bare.startswith("|") else bare
            yield " " * (len(bare) - len(bare.lstrip())) + bare


def packages() -> list[str]:
    """`doojax`, and the packages in it."""
    found = sorted(path.parent for path in ROOT.glob("doojax/**/__init__.py"))
    return [".".join(folder.relative_to(ROOT).parts) for folder in found]


def made() -> dict[str, str]:
    """The texts of the pages that are made, by where they go."""
    pages = {f"reference/{name}.md": reference(name) for name in packages()}
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (limits,) = re.findall(r"^## Limits\n(.*?)(?=^## |\Z)", readme, re.MULTILINE | re.DOTALL)
    pages["limits.md"] = f"# Limits\n{limits}"
    pages["reference/commands.md"] = "\n".join(
        ["# Commands", "", ABOUT_COMMANDS, *commands(COMMANDS, "doojax")]
    )
    pages["docs/in_a_notebook.md"] = cells(ROOT / "docs/notebook.ipynb")
    return pages


def commands(table: Commands, program: str) -> Iterator[str]:
    """A table of commands, and after it the tables that it holds."""
    yield from ["", "| command | what it does |", "| :-- | :-- |"]
    nested = []
    for name, (target, text) in table.items():
        if isinstance(target, str):
            yield f"| [`{program} {name}`][{target.replace(':', '.')}] | {text} |"
        else:
            nested.append((name, target, text))
    for name, inner, text in nested:
        yield from ["", f"## {program} {name}: {text}"]
        yield from commands(inner, f"{program} {name}")


def reference(package: str) -> str:
    """A page with a package's modules."""
    folder = ROOT / package.replace(".", "/")
    tree = ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))
    lines = [f"# {package}", "", ast.get_docstring(tree) or "", *names(tree)]
    own = [item.name for item in tree.body if isinstance(item, ast.FunctionDef | ast.ClassDef)]
    if own:
        lines += block(package, f"members: [{', '.join(own)}]")
    for path in sorted(folder.glob("*.py")):
        if path.stem != "__init__":
            lines += ["", f"## {package}.{path.stem}", *block(f"{package}.{path.stem}")]
    return "\n".join(lines)


def names(tree: ast.Module) -> Iterator[str]:
    """What a package gives under its own name, a line for each of its modules."""
    given: dict[str, list[str]] = {}
    for item in tree.body:
        if isinstance(item, ast.ImportFrom) and item.module:
            shared = [name.name for name in item.names if name.asname == name.name]
            given.setdefault(item.module, []).extend(shared)
    if any(given.values()):
        yield from ["", "To be imported from here:", ""]
    for module, shared in given.items():
        links = [
            f'<autoref optional identifier="{module}.{name}"><code>{name}</code></autoref>' for name in shared
        ]
        if links:
            yield f"- {', '.join(links)}"


def block(name: str, *options: str) -> list[str]:
    """Has mkdocstrings put a module's contents here."""
    return [
        *("", f"::: {name}", "    options:"),
        *("      show_root_heading: false", "      show_root_toc_entry: false"),
        *(f"      {option}" for option in options),
    ]


def cells(notebook: Path) -> str:
    """A notebook's texts and code as a page, and where to get it."""
    texts = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        texts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    return "\n\n".join([texts[0], f"[The notebook]({notebook.name}) to run.", *texts[1:]])
