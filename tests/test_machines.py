"""Machines of many kinds: terminals, users, switches and addresses that not everybody has."""

import io
import os
import pwd

import pytest

from doojax import cli
from doojax.topology.describe import THREADING


@pytest.fixture
def terminal(monkeypatch):
    """A standard output of some encoding; calling it gives what was written."""

    def use(encoding):
        written = io.BytesIO()
        monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, encoding=encoding, write_through=True))
        return lambda: written.getvalue().decode(encoding)

    return use


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
def test_letters_that_a_terminal_lacks_are_spelled_out(encoding, terminal, tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "COMMANDS", {"try": ("tests:try", "try it")})
    monkeypatch.setattr(cli, "load", lambda target: lambda: print("signature: \u2205"))
    said = terminal(encoding)
    assert cli.main(["try"]) == 0
    assert said() == ("signature: \u2205\n" if encoding == "utf-8" else "signature: \\u2205\n")


def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path, capsys):
    (tmp_path / "scene.json").write_bytes(b"\xef\xbb\xbf" + THREADING.read_bytes())
    assert cli.main(["signature", str(THREADING)]) == 0
    plain = capsys.readouterr().out
    assert cli.main(["signature", str(tmp_path / "scene.json")]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == plain.splitlines()[1:]


def test_a_user_without_a_home_or_a_name_needs_neither(monkeypatch, capsys):
    for name in ("HOME", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)

    def unknown(number):
        raise KeyError(f"getpwuid(): uid not found: {number}")

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    assert cli.main(["signature", str(THREADING)]) == 0
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("switched", ["1", "true"])
def test_64_bit_floats_are_refused_at_once(switched, monkeypatch, capsys):
    monkeypatch.setenv("JAX_ENABLE_X64", switched)
    assert cli.main(["inspect", "nothing"]) == 2
    assert "JAX_ENABLE_X64 is set, but data sets, scenes and models" in capsys.readouterr().err
    assert cli.main(["--version"]) == 0


def test_what_jax_debug_nans_stops_is_said_to_be_its_doing(monkeypatch, capsys):
    def fail():
        raise FloatingPointError("invalid value (nan) encountered in sub")

    monkeypatch.setattr(cli, "COMMANDS", {"try": ("tests:try", "try it")})
    monkeypatch.setattr(cli, "load", lambda target: fail)
    monkeypatch.setenv("JAX_DEBUG_NANS", "1")
    assert cli.main(["try"]) == 2
    assert "JAX_DEBUG_NANS is set: without it, NaN stands for what is missing" in capsys.readouterr().err
    monkeypatch.setenv("JAX_DEBUG_NANS", "0")
    with pytest.raises(FloatingPointError):  # a defect of doojax, then
        cli.main(["try"])


def test_brackets_in_a_path_are_no_markup(tmp_path, capsys):
    assert cli.main(["inspect", str(tmp_path / "[bold]data[/bold]")]) == 2
    assert "[bold]data[/bold]" in capsys.readouterr().err.replace("\n", "")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--port", "99999"], "the port is 99999, expected 0 to 65535"),
        (["--port", "-1"], "the port is -1, expected 0 to 65535"),
        (["--host", ""], "the host is empty; name the address to bind to, such as 127.0.0.1"),
        (["--host", "no such host"], "cannot serve on no such host, port 8080"),
    ],
)
def test_addresses_that_no_page_can_have(options, message, tmp_path, capsys):
    assert cli.main(["view", str(tmp_path), *options]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "toy", "--methods", "oracle", "--out", "OUT"], "toy"),
        (
            ["evaluate", "rope_dragging", "--methods", "oracle", "--side-by-side", "-1", "--out", "OUT"],
            "is -1",
        ),
        (["scenes", "toy", "--count", "2", "--seed", "-1", "--out", "OUT"], "seed is -1"),
        (["collect", "toy", "--trajectories", "1", "--seed", str(2**64), "--out", "OUT"], "seed is 18446744"),
    ],
)
def test_numbers_and_names_that_cannot_be_meant(arguments, message, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main([str(out) if argument == "OUT" else argument for argument in arguments]) == 2
    said = capsys.readouterr().err
    assert said.splitlines()[-1].startswith("doojax: error: ") and message in said
    assert not out.exists()


def test_a_billion_lanes_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["plan", "toy", "--planning.lanes", "1000000000"])
    assert stop.value.code == 2
    assert "lanes is 1000000000, expected 1 to 16,384" in capsys.readouterr().err
