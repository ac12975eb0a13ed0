"""The doojax command: every entry resolves and has help; bad input gives one clear line."""

import os
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from doojax import cli
from doojax.optional import EXTRAS


def entries(commands: cli.Commands, names: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    """Every command's names with its target."""
    for name, (target, text) in commands.items():
        assert text and text[0].islower() and not text.endswith("."), f"{name}: one line of help"
        if isinstance(target, str):
            yield (*names, name), target
        else:
            yield from entries(target, (*names, name))


ENTRIES = [pytest.param(names, target, id=" ".join(names)) for names, target in entries(cli.COMMANDS)]


@pytest.fixture(autouse=True)
def no_cache_folder_of_the_user(monkeypatch, tmp_path):
    """Keep `main` from setting the variable for the tests that follow."""
    monkeypatch.setenv(
        "JAX_COMPILATION_CACHE_DIR", os.environ.get("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    )


def fail(error):
    """A command that raises the error."""

    def command(count: int = 1) -> None:
        """Fail."""
        raise error

    return command


@pytest.fixture
def with_command(monkeypatch):
    """Make `doojax try` run the given function."""

    def use(function):
        monkeypatch.setattr(cli, "COMMANDS", {"try": ("tests:try", "try it")})
        monkeypatch.setattr(cli, "load", lambda target: function)

    return use


@pytest.mark.parametrize(("names", "target"), ENTRIES)
def test_every_entry_names_a_documented_function_and_shows_its_help(names, target, capsys):
    function = cli.load(target)
    assert callable(function) and function.__doc__
    with pytest.raises(SystemExit) as stop:
        cli.main([*names, "--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert f"doojax {' '.join(names)}" in shown
    assert function.__doc__.split()[0] in shown


def test_without_arguments_the_commands_are_listed(capsys):
    assert cli.main([]) == 0
    shown = capsys.readouterr().out
    for name, (target, text) in cli.COMMANDS.items():
        assert name in shown
        assert text.split()[0] in shown
        if not isinstance(target, str):
            assert all(inner in shown for inner in target)
    assert cli.main(["--help"]) == 0
    assert capsys.readouterr().out == shown


def test_a_nested_table_is_listed_and_run_in_the_same_way(monkeypatch, capsys):
    ran = []

    def rollouts(batch: int = 1) -> None:
        """Measure."""
        ran.append(batch)

    monkeypatch.setattr(cli, "load", lambda target: rollouts)
    commands: cli.Commands = {
        "bench": ({"rollouts": ("tests:rollouts", "measure rollouts")}, "measure speed")
    }
    monkeypatch.setattr(cli, "COMMANDS", commands)
    assert cli.main([]) == 0
    assert "measure speed (rollouts)" in capsys.readouterr().out
    assert cli.main(["bench"]) == 0
    assert "doojax bench COMMAND" in capsys.readouterr().out
    assert cli.main(["bench", "rollouts", "--batch", "64"]) == 0
    assert ran == [64]
    assert cli.main(["bench", "rolouts"]) == 2
    assert "doojax bench has no command 'rolouts'. Did you mean 'rollouts'?" in capsys.readouterr().err


def test_an_unknown_command_is_answered_with_those_that_exist(capsys):
    assert cli.main(["reprot"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("doojax: error: doojax has no command 'reprot'. Did you mean 'report'? It has: ")
    assert all(name in said for name in cli.COMMANDS)
    assert cli.main(["xyzzy"]) == 2
    assert "Did you mean" not in capsys.readouterr().err


def test_an_unknown_option_is_an_error(with_command, capsys):
    with_command(fail(ValueError("not reached")))
    with pytest.raises(SystemExit) as stop:
        cli.main(["try", "--cuont", "3"])
    assert stop.value.code == 2
    assert "--cuont" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("count is -1; give [at least] 1"), "count is -1; give [at least] 1"),
        (FileNotFoundError(2, "No such file or directory", "data/x"), "data/x: No such file or directory"),
        (FileExistsError("data/x holds another data set"), "data/x holds another data set"),
        (ModuleNotFoundError("No module named 'warp'"), "No module named 'warp'"),
        (
            ModuleNotFoundError("No module named 'ompl'", name="ompl"),
            "No module named 'ompl': pip install 'doojax[bench]'",
        ),
        (OSError(), "OSError"),
    ],
)
def test_bad_input_gives_one_line_and_traceback_the_error_itself(with_command, capsys, error, line):
    with_command(fail(error))
    assert cli.main(["try"]) == 2
    captured = capsys.readouterr()
    assert captured.err == f"doojax: error: {line}\n"
    assert captured.out == ""
    with pytest.raises(type(error)):
        cli.main(["try", "--count", "2", "--traceback"])


def test_every_extra_that_is_named_exists_and_brings_the_package():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    called = {"PIL": "pillow", "yaml": "pyyaml"}
    for module, extra in EXTRAS.items():
        packages = " ".join(project["optional-dependencies"][extra])
        name = called.get(module, module.replace("_", "-"))
        assert name in packages, f"{module} comes with another extra than {extra}"
        assert name not in " ".join(project["dependencies"]), f"{name} comes without any extra"


def test_a_defect_of_ours_is_not_dressed_up_as_bad_input(with_command):
    with_command(fail(AttributeError("a defect")))
    with pytest.raises(AttributeError, match="a defect"):
        cli.main(["try"])


def test_an_interrupt_ends_with_130(with_command, capsys):
    with_command(fail(KeyboardInterrupt()))
    assert cli.main(["try"]) == 130
    assert capsys.readouterr().err == "doojax: interrupted\n"


@pytest.mark.parametrize(("given", "used"), [(None, ".cache/doojax/jax"), ("/tmp/mine", "/tmp/mine")])
def test_programs_keep_compiled_functions_where_the_user_says_or_in_his_cache(
    with_command, monkeypatch, given, used
):
    seen = []

    def look() -> None:
        """Look."""
        seen.append(os.environ["JAX_COMPILATION_CACHE_DIR"])

    with_command(look)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    if given:
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", given)
    cli.main(["try"])
    assert seen[0].endswith(used)


def python(code: str, **options) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, **options)


def test_the_list_of_commands_loads_nothing_heavy():
    code = """
import sys
from doojax.cli import main
main(["--version"]), main([])
print(sorted({"jax", "mujoco", "viser", "matplotlib", "tyro"} & set(sys.modules)))
"""
    result = python(code)
    assert result.stdout.startswith("doojax 0."), result.stderr
    assert result.stdout.endswith("[]\n")


def test_a_reader_that_goes_away_is_no_error():
    code = """
import sys
from doojax import cli
from doojax.optional import EXTRAS
def much() -> None:
    '''Print.'''
    for i in range(100000): print(i)
cli.load = lambda target: much
cli.COMMANDS = {"much": ("a:b", "print")}
sys.exit(cli.main(["much"]))
"""
    result = subprocess.run(
        ["bash", "-c", '"$0" -c "$1" | head -n 1; exit "${PIPESTATUS[0]}"', sys.executable, code],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (result.stdout, result.stderr, result.returncode) == ("0\n", "", 141)
