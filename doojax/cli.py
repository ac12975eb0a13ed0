"""The `doojax` command: it finds the function behind a command's name and lets tyro make its command line.

Which commands there are, stands in `doojax.commands`.
"""

import contextlib
import difflib
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

import doojax
from doojax.commands import COMMANDS, Commands, first_name, load
from doojax.optional import advice

X64 = (
    "JAX_ENABLE_X64 is set, but data sets, scenes and models of the doojax command are of 32-bit numbers: "
    "unset it; as a library, doojax computes in either"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status: 0, 2 for bad input, 130 when interrupted.

    Bad input (a ValueError, an OSError or a missing optional package, raised by the command) is reported in
    one line; with `--traceback` anywhere among the arguments it is raised as it is.

    Args:
        argv: the arguments after the program's name; those of this process by default.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    with_traceback = "--traceback" in arguments
    arguments = [argument for argument in arguments if argument != "--traceback"]

    for stream in (sys.stdout, sys.stderr):  # a terminal that lacks a letter gets its number, not an error
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    keep_compiled()
    try:
        status = run(arguments, COMMANDS, "doojax")
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        complain("interrupted")
        return 130
    except BrokenPipeError:  # the reader of our output, such as `head`, has gone: nothing is left to say
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (ValueError, OSError, ModuleNotFoundError) as error:
        if with_traceback:
            raise
        complain(f"error: {explain(error)}")
        return 2
    except Exception as error:
        said = explain_limit(error)
        if with_traceback or said is None:
            raise
        complain(f"error: {said}")
        return 2


def keep_compiled() -> None:
    """Have what JAX compiles kept in the user's cache, unless he says where, or has no home.

    By an environment variable, because that needs no import of jax here and reaches worker processes.
    """
    with contextlib.suppress(RuntimeError):  # an unknown user without HOME
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "doojax" / "jax"
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))


def run(arguments: Sequence[str], commands: Commands, program: str) -> int:
    """Run the command that the first argument names, looking into nested tables."""
    if not arguments or arguments[0] in ("-h", "--help"):
        show(commands, program)
        return 0
    name, rest = first_name(arguments, commands)
    if name == "--version" and program == "doojax":
        print(f"doojax {doojax.__version__}")
        return 0
    if name not in commands:
        raise ValueError(unknown(name, commands, program))
    target, _ = commands[name]
    program = f"{program} {name}"
    if not isinstance(target, str):
        return run(rest, target, program)

    if os.environ.get("JAX_ENABLE_X64", "0").lower() not in ("", "0", "false", "off", "no"):
        raise ValueError(X64)
    function = load(target)
    import tyro  # here, so that the list of commands appears at once

    tyro.cli(function, args=rest, prog=program)
    return 0


def show(commands: Commands, program: str) -> None:
    """Print the commands of one table."""
    table = Table(title=f"{program} COMMAND ...", title_justify="left", show_header=False, box=None)
    for name, (target, text) in commands.items():
        nested = "" if isinstance(target, str) else f" ({', '.join(target)})"
        table.add_row(f"[bold cyan]{name}[/]", escape(text + nested))
    console = Console()
    console.print(table)
    console.print(
        f"\n{program} COMMAND --help lists the options of one; --traceback shows where an error arose."
    )


def unknown(name: str, commands: Commands, program: str) -> str:
    """What to say about a command that does not exist."""
    close = difflib.get_close_matches(name, commands, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"{program} has no command {name!r}.{hint} It has: {', '.join(commands)}."


def explain(error: Exception) -> str:
    """An error's message in words that need no knowledge of Python."""
    if isinstance(error, ModuleNotFoundError):
        return advice(error)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error) or type(error).__name__


def explain_limit(error: Exception) -> str | None:
    """What to say where memory is short, or JAX was told to refuse a number; None for a defect of doojax."""
    text = (str(error) or type(error).__name__).splitlines()[0]
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in text:
        return f"there is not enough memory for this ({text}): ask for less at once"
    if isinstance(error, FloatingPointError) and os.environ.get("JAX_DEBUG_NANS", "0") not in ("0", "false"):
        return f"{text} (JAX_DEBUG_NANS is set: without it, NaN stands for what is missing or has failed)"
    return None


def complain(text: str) -> None:
    """Print one red line on the standard error."""
    Console(stderr=True, soft_wrap=True).print(f"[red]doojax: {escape(text)}[/]", highlight=False)


if __name__ == "__main__":
    sys.exit(main())
