"""Rules for every module of doojax, read from its source: who imports whom, and what nobody writes."""

import ast
import importlib.metadata
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "doojax").rglob("*.py"))

# What every part may import; of these themselves each only those before it.
GROUND = [
    "optional",
    "types",
    "modules",
    "keys",
    "parts",
    "reading",
    "files",
    "terminal",
    "commands",
    "actions",
    "goals",
]
# What else each part may import, beside itself: a model knows no simulator, planning knows no task.
MAY_IMPORT = {
    "geometry": set(),
    "topology": {"geometry"},
    "robots": {"geometry"},
    "simulation": {"geometry", "robots"},
    "tasks": {"geometry", "topology", "robots", "simulation"},
    "datasets": {"geometry", "simulation", "tasks"},
    "models": {"geometry", "topology", "robots"},
    "augmentation": {
        "geometry",
        "topology",
        "robots",
        "simulation",
        "tasks",
        "datasets",
        "models",
        "learning",
    },
    "learning": {"geometry", "simulation", "tasks", "datasets", "models"},
    "planning": {"geometry", "topology", "robots", "models"},
    "environments": {"geometry", "simulation", "tasks", "models"},
}
EVERYTHING = set(MAY_IMPORT)
MAY_IMPORT |= {"experiments": EVERYTHING, "benchmarks": EVERYTHING | {"experiments"}}
MAY_IMPORT |= {"viewer": EVERYTHING | {"experiments", "benchmarks"}, "cli": set()}
ADAPTERS = {("doojax.planning.simulated", "simulation")}  # modules that tie two parts together
ALLOWED_IN = {  # packages from elsewhere that only some parts may import
    "mujoco": {"robots", "simulation", "benchmarks"},
    "matplotlib": {"experiments", "benchmarks", "viewer"},
    "viser": {"experiments", "benchmarks", "viewer"},
}
NO_PHASE = {"actions", "models", "planning"}
LAZY = {"trimesh"}  # slow to load and rarely needed: imported inside functions
UNSAFE = {"pickle", "cloudpickle", "dill", "shelve", "joblib", "marshal"}
LONGEST = 400  # lines


def part_of(module: str) -> str:
    """What `GROUND` and `MAY_IMPORT` call the place of a doojax module; "" for doojax itself."""
    return module.split(".")[1] if "." in module else ""


def allowed(here: str) -> set[str]:
    """The parts that a part may import."""
    if here in GROUND:
        return set(GROUND[: GROUND.index(here) + 1])
    return {here, *GROUND, *MAY_IMPORT[here]}


def imports(tree: ast.AST, module: str, is_package: bool) -> Iterator[tuple[ast.stmt, str]]:
    """Statement and absolute name of everything imported, at module level or inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = [node.module] if node.module else []
            if node.level:
                parents = module.split(".")
                base = parents[: len(parents) - node.level + is_package] + base
            # `from doojax import geometry` imports a module, `from doojax.geometry import sdf` may.
            yield from ((node, ".".join([*base, alias.name])) for alias in node.names)


def not_run_on_import(tree: ast.AST) -> set[ast.AST]:
    """The nodes inside functions and inside `if TYPE_CHECKING`."""
    outer = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        or (isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"))
    ]
    return {inner for node in outer for inner in ast.walk(node)}


def complaints(source: str, module: str, is_package: bool = False) -> Iterator[tuple[int, str]]:
    """Line and text for every rule that a module's source breaks."""
    tree = ast.parse(source)
    here = part_of(module)
    length = len(source.splitlines())
    if length > LONGEST:
        yield length, f"has {length} lines; {LONGEST} are the most"
    if here and here not in {*GROUND, *MAY_IMPORT}:
        yield 1, f"is in no known part; add {here!r} to MAY_IMPORT"
        return
    later = not_run_on_import(tree)
    for node, name in imports(tree, module, is_package):
        outer = name.split(".")[0]
        there = part_of(name)
        if outer == "doojax" and there in {*GROUND, *MAY_IMPORT}:
            if not here:
                yield node.lineno, f"imports {name}; doojax itself imports none of its parts"
            elif there not in allowed(here) and (module, there) not in ADAPTERS:
                yield node.lineno, f"imports {name}, which {here} may not"
        if here not in ALLOWED_IN.get(outer, {here}):
            yield node.lineno, f"imports {outer}, which only {', '.join(sorted(ALLOWED_IN[outer]))} may"
        if outer in UNSAFE:
            yield node.lineno, f"imports {outer}, which runs what a file says"
        if outer in LAZY and node not in later:
            yield node.lineno, f"imports {outer} at module level; import it inside the function that needs it"
        if name == "jax.random.PRNGKey":
            yield node.lineno, "imports jax.random.PRNGKey; use jax.random.key"
    for node in ast.walk(tree):
        yield from ((node.lineno, text) for text in habits(node, here))  # type: ignore


def habits(node: ast.AST, here: str) -> Iterator[str]:
    """What is wrong with one node of the source, whatever it imports."""
    if isinstance(node, ast.Assert):
        yield "asserts, which python -O drops; raise an error that says what to do"
    if isinstance(node, ast.Attribute) and ast.unparse(node).endswith("random.PRNGKey"):
        yield "uses PRNGKey; use jax.random.key"
    if here in NO_PHASE and isinstance(node, ast.Constant) and node.value in ("constrained", "unconstrained"):
        yield f"names the phase {node.value!r}; a task's phase is bound when it is made"
    if isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False":
        yield "allows pickle"
    called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
    if here != "keys" and re.search(r"\brandom\.key$|^key$", called):
        yield "makes a key of a bare seed, which others make, too; use doojax.keys.stream"
    if here != "commands" and re.fullmatch(r"(importlib\.)?import_module|__import__", called):
        yield f"calls {called}, which hides an import from this test"
    if here == "cli":
        return
    if re.fullmatch(r"(jax\.)?config\.update|(os\.)?(putenv|unsetenv)", called) or re.fullmatch(
        r"(os\.)?environ\.(setdefault|update|pop|popitem|clear)", called
    ):
        yield f"calls {called}; only the doojax command may change the whole process"
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign | ast.Delete):
        targets = node.targets
    elif isinstance(node, ast.AugAssign | ast.AnnAssign):
        targets = [node.target]
    for target in targets:
        if re.match(r"jax\.config\.|(os\.)?environ\b", ast.unparse(target)):
            yield f"sets {ast.unparse(target)}; only the doojax command may change the whole process"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_keeps_the_rules(path):
    is_package = path.name == "__init__.py"
    relative = path.relative_to(ROOT).with_suffix("")
    module = ".".join(relative.parts[:-1] if is_package else relative.parts)
    found = [
        f"{path.relative_to(ROOT)}:{line} {text}"
        for line, text in complaints(path.read_text(), module, is_package)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("doojax.geometry.sdf", "from doojax.planning import rrt", "which geometry may not"),
        ("doojax.geometry.sdf", "def f():\n    import doojax.topology.linking", "which geometry may not"),
        ("doojax.geometry.sdf", "from ..topology import linking", "doojax.topology.linking"),
        ("doojax.geometry.sdf", "from doojax import tasks", "which geometry may not"),
        ("doojax.experiments.trials.trial", "from doojax.viewer import app", "which experiments may not"),
        ("doojax.models.dynamics", "from doojax.simulation import state", "which models may not"),
        ("doojax.planning.rrt", "from doojax.tasks import base", "which planning may not"),
        ("doojax.planning.rrt", "from doojax.simulation import state", "which planning may not"),
        ("doojax.topology.linking", "from doojax.robots import robot", "which topology may not"),
        ("doojax.types", "from .goals import Goal", "which types may not"),
        ("doojax.types", "from .geometry import sdf", "which types may not"),
        ("doojax", "from .tasks import make_task", "imports none of its parts"),
        (
            "doojax.tasks.base",
            "from mujoco import mjx",
            "imports mujoco, which only benchmarks, robots, simulation may",
        ),
        ("doojax.planning.mppi", "import matplotlib.pyplot as plt", "imports matplotlib, which only"),
        ("doojax.datasets.store", "import pickle", "runs what a file says"),
        ("doojax.datasets.store", "np.load(path, allow_pickle=True)", "allows pickle"),
        ("doojax.geometry.sdf", "import trimesh", "at module level"),
        ("doojax.geometry.sdf", "if True:\n    import trimesh", "at module level"),
        ("doojax.geometry.sdf", "x = 1\nassert x", "asserts"),
        ("doojax.geometry.sdf", "key = jax.random.PRNGKey(0)", "jax.random.key"),
        ("doojax.geometry.sdf", "from jax.random import PRNGKey", "jax.random.key"),
        ("doojax.geometry.sdf", "jax.config.update('jax_enable_x64', True)", "may change the whole process"),
        ("doojax.geometry.sdf", "jax.config.jax_enable_x64 = True", "may change the whole process"),
        ("doojax.geometry.sdf", "os.environ['XLA_FLAGS'] = ''", "may change the whole process"),
        ("doojax.geometry.sdf", "os.environ['XLA_FLAGS'] += ''", "may change the whole process"),
        ("doojax.geometry.sdf", "del os.environ['XLA_FLAGS']", "may change the whole process"),
        ("doojax.geometry.sdf", "os.environ.setdefault('A', '1')", "may change the whole process"),
        ("doojax.geometry.sdf", "importlib.import_module('viser')", "hides an import"),
        ("doojax.geometry.sdf", "x = 1\n" * 401, "has 401 lines"),
        ("doojax.learning.fit", "key = jax.random.key(seed)", "use doojax.keys.stream"),
        ("doojax.learning.fit", "from jax.random import key\nk = key(seed)", "use doojax.keys.stream"),
        ("doojax.planning.rrt", "task.valid(state, 'constrained')", "names the phase 'constrained'"),
        ("doojax.extras.things", "", "no known part"),
    ],
)
def test_a_broken_rule_is_noticed(module, source, complaint):
    found = complaints(source, module, is_package=module == "doojax")
    assert complaint in " ".join(text for _, text in found)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        (
            "doojax.geometry.sdf",
            "from doojax.types import Obstacles\nfrom . import frames\nfrom .frames import x",
        ),
        ("doojax.geometry.sdf", "def f():\n    import trimesh"),
        ("doojax.geometry.sdf", "if TYPE_CHECKING:\n    from trimesh import Trimesh"),
        (
            "doojax.simulation.rope",
            "import mujoco\nfrom mujoco import mjx\nfrom doojax.geometry import sdf",
        ),
        ("doojax.cli", "os.environ.setdefault('A', '1')"),
        ("doojax.commands", "importlib.import_module(x)"),
        (
            "doojax.geometry.sdf",
            "x = os.environ.get('HOME')\ny = {**os.environ}\nnp.load(p, allow_pickle=False)",
        ),
        ("doojax", "__version__ = '1'"),
    ],
)
def test_what_keeps_the_rules_is_let_through(module, source):
    assert list(complaints(source, module)) == []


def test_relative_imports_of_a_package_start_from_itself():
    assert list(complaints("from .sdf import x", "doojax.geometry", is_package=True)) == []
    (complaint,) = complaints("from ..tasks import x", "doojax.geometry", is_package=True)
    assert "doojax.tasks.x" in complaint[1]


def test_what_is_imported_is_declared():
    """Every package that doojax imports is a dependency of its own, not by luck that of another."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [name for group in project["optional-dependencies"].values() for name in group]
    declared = {canonical(name) for name in [*project["dependencies"], *extras]} | {"doojax"}
    providers = importlib.metadata.packages_distributions()
    for path in SOURCES:
        for node, name in imports(ast.parse(path.read_text()), "doojax.x.y", False):
            outer = name.split(".")[0]
            if outer not in sys.stdlib_module_names and outer != "doojax":
                found = {canonical(provider) for provider in providers.get(outer, [outer])}
                assert found & declared, (
                    f"{path.relative_to(ROOT)}:{node.lineno} imports {outer}: add it to pyproject.toml"
                )


def extras_of(requirements: list[str]) -> list[str]:
    """The names in the brackets of "doojax[figures,view]"."""
    from packaging.requirements import Requirement

    return sorted({extra for one in requirements for extra in Requirement(one).extras})


def canonical(requirement: str) -> str:
    """The name in a requirement such as "ImageIO>=2", as pyproject.toml and the lock may both spell it."""
    return re.match(r"[\w.-]+", requirement)[0].lower().replace("_", "-").replace(".", "-")  # type: ignore


def test_the_lock_holds_every_dependency_and_nothing_but_versions():
    from packaging.requirements import Requirement

    lines = (ROOT / "requirements.lock").read_text().splitlines()
    assert [line for line in lines if not re.fullmatch(r"[\w.-]+==[\w.]+", line)] == []
    locked = {canonical(line): line.split("==")[1] for line in lines}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    own = [line for line in extras["dev"] if canonical(line) == "doojax"]  # other extras, all of them locked
    needed = [
        *project["project"]["dependencies"],
        *(line for extra in ["dev", *extras_of(own)] for line in extras[extra] if line not in own),
        *project["build-system"]["requires"],
    ]
    for requirement in map(Requirement, needed):
        version = locked.get(canonical(requirement.name))
        assert version, f"requirements.lock lacks {requirement}; run scripts/lock"
        assert requirement.specifier.contains(version), (
            f"{requirement} is locked at {version}; run scripts/lock"
        )
