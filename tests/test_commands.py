"""Commands as texts: what is written is read back to the same call, for every command and any values."""

import inspect
import typing
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.commands import COMMANDS, Commands, command_line, load, names_of, parsed
from doojax.experiments.reports.tables import report
from doojax.experiments.trials.evaluate import evaluate
from doojax.experiments.trials.plan import plan
from doojax.planning import RrtSettings


def functions(commands: Commands):
    """Every command's function."""
    for target, _ in commands.values():
        if isinstance(target, str):
            yield load(target)
        else:
            yield from functions(target)


FUNCTIONS = list(functions(COMMANDS))
WORDS = st.from_regex(r"[A-Za-z0-9_./ '\"$&=üµ-]{1,12}", fullmatch=True).filter(
    lambda word: word not in ("None", "&&") and not word.startswith("-") and word.strip() == word
)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


def values(kind: typing.Any) -> st.SearchStrategy:
    """Values of a parameter's type."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(kind, typing.TypeAliasType):
        return values(kind.__value__)
    if origin is typing.Annotated:
        return values(inner[0])
    if origin in (typing.Union, UnionType):
        return st.one_of([values(one) for one in inner])
    if origin is typing.Literal:
        return st.sampled_from(inner)
    if origin is tuple and inner[-1] is Ellipsis:
        return st.lists(values(inner[0]), min_size=1, max_size=3).map(tuple)
    if origin is tuple:
        return st.tuples(*map(values, inner))
    plain = {str: WORDS, int: st.integers(-(10**6), 10**6), float: NUMBERS, bool: st.booleans()}
    plain |= {Path: WORDS.map(Path), NoneType: st.none()}
    return plain[kind]


def given_to(function):
    """Arguments of a command; of settings one or none differs from the default, by a little."""
    drawn = {}
    for name, kind in typing.get_type_hints(function, include_extras=True).items():
        if name == "return":
            continue
        parameter = inspect.signature(function).parameters[name]
        if is_dataclass(kind):
            default = parameter.default
            changed = [
                replace(default, **{one.name: value + 1})
                for one in fields(default)
                if type(value := getattr(default, one.name)) is int
            ]
            drawn[name] = st.sampled_from([default, *changed])
        elif parameter.default is inspect.Parameter.empty:
            drawn[name] = values(kind)
        else:
            drawn[name] = st.just(parameter.default) | values(kind)
    return st.fixed_dictionaries(drawn)


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: " ".join(names_of(function)))
def test_what_is_written_is_read_back_to_the_same_call(function):
    @settings(max_examples=12, deadline=None)
    @given(given_to(function))
    def there_and_back(arguments):
        line = command_line(function, arguments)
        ((found, again),) = parsed(line)
        assert found is function
        assert again == arguments
        assert {name: type(value) for name, value in again.items()} == {
            name: type(value) for name, value in arguments.items()
        }
        assert command_line(function, again) == line

    there_and_back()


def test_what_is_not_the_default_is_written_and_nothing_else():
    some = {"task": "toy", "methods": ("oracle",), "out": Path("a folder")}
    assert command_line(evaluate, some) == "doojax evaluate toy --methods oracle --out 'a folder'"
    more = {"models": Path("runs"), "seed": 3, "engine": "mjx", "trials": 7, "scenes": Path("s")}
    more |= {"planning": RrtSettings(shortcuts=0), "keep_trees": True}
    assert command_line(evaluate, some | more) == (
        "doojax evaluate toy --methods oracle --out 'a folder' --models runs --scenes s --trials 7 --seed 3 "
        "--engine mjx --planning.shortcuts 0 --keep-trees"
    )
    goal = {"task": "toy", "execute": False, "goal": (0.1, -1e-05, 0.0)}
    assert command_line(plan, goal) == "doojax plan toy --goal 0.1 -1e-05 0.0 --no-execute"


def test_commands_that_follow_one_another_are_read_one_by_one():
    first, second = parsed("doojax evaluate toy --methods oracle --out x && doojax compare x")
    assert first[0] is evaluate and second[1]["folder"] == Path("x")


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("doojax evaluate toy --methods oracle", "Missing.*--out"),  # as older results recorded it
        ("doojax evaluate toy --methods oracle --out x --sceens y", "sceens"),
        ("doojax evalute toy", "names no command of: collect, train"),
        ("doojax bench", "names no command of: planner"),
        ("python -m doojax", "should begin with doojax"),
        ("doojax compare 'x", "cannot be read"),
        ("doojax compare x &&", "should begin with doojax"),
    ],
)
def test_what_is_no_command_is_refused(line, complaint):
    with pytest.raises(ValueError, match=complaint):
        parsed(line)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"task": "toy", "methods": ("a",)}, "evaluate needs out"),
        ({"task": "toy", "methods": ("a",), "out": Path("x"), "model": 3}, "evaluate has no model; it has:"),
        ({"task": "toy", "methods": ("--a", "b"), "out": Path("x")}, "may begin with a dash"),
        ({"task": "None", "methods": ("a",), "out": Path("x")}, "stands for something else"),
    ],
)
def test_what_no_command_line_gives_is_refused(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        command_line(evaluate, arguments)
    with pytest.raises(ValueError, match="is no command of doojax"):
        command_line(test_commands_that_follow_one_another_are_read_one_by_one, {})


def test_words_that_begin_with_a_dash_are_no_options():
    for arguments in (
        {"task": "-t", "out": Path("-x")},
        {"task": "toy", "seed": -3, "goal": (-1.0, -2.0, -3.0)},
    ):
        ((_, again),) = parsed(command_line(plan, arguments))
        assert {name: again[name] for name in arguments} == arguments


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: " ".join(names_of(function)))
def test_no_command_writes_into_the_published_results_unless_it_is_told_to(function):
    """What a reader types must not change what this project publishes."""
    for name, parameter in inspect.signature(function).parameters.items():
        if isinstance(parameter.default, Path) and function is not report:  # which writes no results
            assert not parameter.default.is_relative_to("results"), name
