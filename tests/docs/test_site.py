"""The documentation site: what its pages are made of, and that all of it builds without a warning."""

import importlib.util
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import griffe
import pytest

ROOT = Path(__file__).parents[2]
SITE = ROOT / "docs/site"


def module(name):
    """A file of the site's own, which no package holds."""
    spec = importlib.util.spec_from_file_location(f"site_{name}", SITE / f"{name}.py")
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


@pytest.fixture(scope="module")
def pages():
    return module("pages")


def test_marks_are_gone_and_lists_are_nested_as_the_site_reads_them(pages):
    text = [
        "it reaches",
        "  <!-- row:planning:success_rate task=toy -->97 %<!-- /row -->; more",
        "- one",
        "  - below one",
        "```",
        "  <!-- kept --> as it is",
        "```",
        "  - below again",
        "| a=1,b=2 | 1,000 |",
    ]
    assert list(pages.plain(text)) == [
        "it reaches",
        "    97 %; more",
        "- one",
        "    - below one",
        "```",
        "  <!-- kept --> as it is",
        "```",
        "    - below again",
        "| a=1, b=2 | 1,000 |",
    ]


def test_every_module_of_doojax_is_in_the_reference_once(pages):
    made = [text for name, text in pages.made().items() if name.startswith("reference/doojax")]
    there = [line.removeprefix("::: ") for text in made for line in text.splitlines() if line[:4] == "::: "]
    assert len(there) == len(set(there))
    files = [path.relative_to(ROOT).with_suffix("") for path in ROOT.glob("doojax/**/*.py")]
    assert {".".join(path.parts) for path in files if path.name != "__init__"} <= set(there)
    assert "doojax.simulation.engines" in there, "functions of a package itself are shown, too"


def test_what_a_package_gives_links_to_where_it_is_from(pages):
    assert (
        '- <autoref optional identifier="doojax.datasets.store.Dataset"><code>Dataset</code></autoref>'
        in pages.reference("doojax.datasets").splitlines()
    )


def test_every_command_is_in_the_table_even_those_of_bench(pages):
    text = pages.made()["reference/commands.md"]
    assert "| [`doojax train policy`][doojax.experiments.training.policy.train_policy] | train a pol" in text
    assert "| [`doojax bench mppi`][doojax.benchmarks.mppi.mppi] |" in text


def test_fields_are_described_by_their_comments_and_shapes_keep_their_quotes(tmp_path):
    code = '''
        from jaxtyping import Array, Float

        class Rope:
            """A rope."""

            points: Float[Array, "*b N 3"]  # world frame, metres
            mass: Float[Array, "N"] = (
                1
            )  # kg
            _hidden: int  # no

        def lengths(rope: Rope, scale: Float[Array, ""]) -> dict[str, Float[Array, "N"]]:
            """Metres."""
    '''
    (tmp_path / "ropes.py").write_text(textwrap.dedent(code))
    own = module("comments")
    extensions = griffe.load_extensions(own.FieldComments(), own.Shapes())
    found = griffe.load("ropes", search_paths=[tmp_path], extensions=extensions)
    assert found["Rope"].docstring.value.endswith(
        "\n\nAttributes:\n    points: world frame, metres\n    mass: kg"
    )
    assert str(found["Rope.points"].annotation) == 'Float[Array, "*b N 3"]'
    assert str(found["lengths"].parameters["scale"].annotation) == 'Float[Array, ""]'
    assert str(found["lengths"].returns) == 'dict[str, Float[Array, "N"]]'


def build(out: Path) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", SITE / "mkdocs.yml", "-d", out]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run(command, capture_output=True, text=True, timeout=400, env=environment)


@pytest.mark.slow  # half a minute
def test_the_site_builds_strictly_and_needs_nothing_from_elsewhere(tmp_path):
    ran = build(tmp_path / "site")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    home = (tmp_path / "site/index.html").read_text()
    assert "<!-- row" not in home and 'href="docs/planning/"' in home
    assert (tmp_path / "site/results/simulation/rope_dragging.png").stat().st_size > 1000
    reference = (tmp_path / "site/reference/doojax.planning/index.html").read_text()
    assert 'id="doojax.planning.rrt.Rrt"' in reference
    for page in (tmp_path / "site").rglob("*.html"):
        text = page.read_text()
        assert 'src="http' not in text and 'rel="stylesheet" href="http' not in text, page
