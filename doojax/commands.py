"""The commands of `doojax`, and the way from what a command was given to the line that gives it again.

A command is a plain typed function with a docstring. To add one, write a line in `COMMANDS`; the function's
module is imported only when its command is run. `command_line` writes a call as the line that a user would
type, and `parsed` reads it back, to the same values: what is recorded beside a figure can be run again.
"""

import functools
import importlib
import inspect
import io
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

# A command's name -> ("module:function", one line of help), or (a table of its own, one line of help).
type Commands = Mapping[str, tuple[str | Commands, str]]

PROGRAM, AND = "doojax", "&&"  # between commands of which each needs the one before

BENCHMARKS: Commands = {
    "planner": ("doojax.benchmarks.planner:planner", "extensions per second beside OMPL's RRT"),
    "rollouts": ("doojax.benchmarks.rollouts:rollouts", "steps per second of every engine"),
    "package": (
        "doojax.benchmarks.package:package",
        "size of the wheel, seconds of an import, cells of a sweep a minute",
    ),
    "collect": ("doojax.benchmarks.collection:collection", "minutes for the thesis's data"),
    "mppi": ("doojax.benchmarks.mppi:mppi", "control of a pendulum, beside pytorch-mppi"),
    "motion": (
        "doojax.benchmarks.motion:motion",
        "motions of the dual arm among a rack, beside OMPL's RRTConnect",
    ),
    "kinematics": (
        "doojax.benchmarks.kinematics:kinematics",
        "inverse kinematics: how often and how soon, beside mink",
    ),
    "augment": (
        "doojax.benchmarks.augmentation:augmentation",
        "augmentations per second, and how far their outcomes are from the simulator's",
    ),
    "fluid": ("doojax.benchmarks.fluid:fluid", "a column at rest, a dam that breaks, particles a second"),
    "physics": ("doojax.benchmarks.physics:physics", "closed forms, engines beside each other, penetration"),
    "cosserat": (
        "doojax.benchmarks.cosserat:cosserat",
        "errors and times in the package cosseratbench, beside its MuJoCo adapter",
    ),
    "training": (
        "doojax.benchmarks.training:training",
        "train steps per second with 1 and 8 members, and in flax",
    ),
    "classifiers": (
        "doojax.benchmarks.classifiers:classifiers",
        "microseconds a judgement takes, from distances and from voxels",
    ),
    "viewer": ("doojax.viewer.bench:viewer", "how soon the page opens and how fast it follows"),
    "signature": (
        "doojax.benchmarks.signature:signature",
        "grasp loop signatures against the h-signature package",
    ),
}

COMMANDS: Commands = {
    "collect": ("doojax.datasets.collect:collect", "collect random trajectories of a task"),
    "train": ("doojax.experiments.training.train:train", "train dynamics, a classifier, a recovery network"),
    "train policy": (
        "doojax.experiments.training.policy:train_policy",
        "train a policy of a task by trying, for doojax evaluate",
    ),
    "train validity": (
        "doojax.experiments.training.validity:train_validity",
        "learn which transforms of examples are valid, for doojax augment",
    ),
    "augment": (
        "doojax.augmentation.command:augment_dataset",
        "move what a data set holds to where it is as valid",
    ),
    "augmentation-study": (
        "doojax.experiments.sweeps.augmentation:augmentation_study",
        "train with and without augmentation where data are few, and compare",
    ),
    "adaptation-study": (
        "doojax.experiments.sweeps.adaptation:adaptation_study",
        "adapt dynamics from one rope to another among obstacles, and compare methods",
    ),
    "watering-study": (
        "doojax.experiments.sweeps.watering:watering_study",
        "adapt dynamics of pouring to a plant by several methods, and compare",
    ),
    "evaluate-model": (
        "doojax.experiments.training.evaluate:evaluate_model",
        "measure a trained model on data that it has not seen",
    ),
    "predict": (
        "doojax.experiments.training.predict:predict",
        "record what a model predicts along stored trajectories, to look at where it is wrong",
    ),
    "sweep": (
        "doojax.experiments.sweeps.command:sweep",
        "run a command for every value of what a spec varies, and gather the figures",
    ),
    "sweep-threshold": (
        "doojax.experiments.sweeps.threshold:sweep_threshold",
        "train classifiers for several thresholds and seeds at once, and measure them",
    ),
    "import": (
        "doojax.datasets.imports.command:import_trajectories",
        "make a data set of trajectories that were recorded elsewhere",
    ),
    "export": (
        "doojax.datasets.exports.command:export",
        "write a data set as a folder that LeRobot or Minari reads",
    ),
    "inspect": ("doojax.datasets.inspect:inspect", "print what a data set holds and check it"),
    "render": ("doojax.viewer.render:render", "draw a data set, a prediction or a trial without a browser"),
    "plan": ("doojax.experiments.trials.plan:plan", "plan and execute in one scene"),
    "scenes": ("doojax.experiments.trials.scenes:scenes", "draw a set of scenes for trials"),
    "evaluate": ("doojax.experiments.trials.evaluate:evaluate", "try methods on the same scenes"),
    "regrasp": (
        "doojax.experiments.regrasping.command:regrasp",
        "two arms bring a fastened rope's end to a place, regrasping as they do",
    ),
    "regrasp-scenes": (
        "doojax.experiments.regrasping.scenes:regrasp_scenes",
        "draw a set of scenes for regrasp",
    ),
    "online": (
        "doojax.experiments.online.command:online",
        "learn from one's own trials, again and again, and measure",
    ),
    "compare": (
        "doojax.experiments.reports.compare:compare",
        "tables, a figure and paired tests of an evaluation",
    ),
    "replay": ("doojax.datasets.replay:replay", "simulate a stored trajectory again"),
    "signature": (
        "doojax.topology.describe:signature",
        "print the grasp loop signature of a described scene",
    ),
    "view": ("doojax.viewer.app:view", "look at data sets, predictions and trials in a browser"),
    "bench": (BENCHMARKS, "measure speed"),
    "report": (
        "doojax.experiments.reports.tables:report",
        "write the tables of README and docs from results/",
    ),
}


def first_name(words: Sequence[str], commands: Commands) -> tuple[str, list[str]]:
    """The command that words begin with, of two words if there is one of both, and what follows it.

    It need not be one of ``commands``; "" where there are no words.
    """
    for length in (2, 1):
        if (name := " ".join(words[:length])) in commands:
            return name, list(words[length:])
    return "".join(words[:1]), list(words[1:])


def load(target: str) -> Callable[..., Any]:
    """The function that "module:function" names."""
    module, _, function = target.partition(":")
    return getattr(importlib.import_module(module), function)


def call(function: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """A command's function with all its arguments by name, as `parsed` gives them."""
    bound = inspect.BoundArguments(inspect.signature(function), dict(arguments))  # type: ignore[arg-type]
    return function(*bound.args, **bound.kwargs)


def names_of(function: Callable[..., Any], commands: Commands = COMMANDS) -> tuple[str, ...]:
    """What a user types after `doojax` to run ``function``, such as ("bench", "rollouts").

    Raises:
        ValueError: no command runs it.
    """
    wanted = f"{function.__module__}:{function.__name__}"

    def found(table: Commands, names: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        for name, (target, _) in table.items():
            if target == wanted:
                yield (*names, *name.split())
            elif not isinstance(target, str):
                yield from found(target, (*names, name))

    for names in found(commands, ()):
        return names
    raise ValueError(f"{wanted} is no command of {PROGRAM}; add it to doojax.commands.COMMANDS")


def command_line(function: Callable[..., Any], arguments: Mapping[str, Any]) -> str:
    """The line that runs ``function`` with these arguments: all that are not the defaults, and no others.

    Args:
        function: of a command.
        arguments: by parameter; for those that are left out the defaults count.

    Raises:
        ValueError: for a function that is no command, an unknown or missing argument, or a value that no
            command line gives, such as a text in a list that begins with a dash.
    """
    parameters = inspect.signature(function).parameters
    unknown = sorted(set(arguments) - set(parameters))
    if unknown:
        raise ValueError(f"{function.__name__} has no {', '.join(unknown)}; it has: {', '.join(parameters)}")
    positional, options = [], []
    for name, parameter in parameters.items():
        value = arguments.get(name, parameter.default)
        if value is inspect.Parameter.empty:
            raise ValueError(f"{function.__name__} needs {name}")
        if parameter.kind is inspect.Parameter.POSITIONAL_ONLY:
            if value != parameter.default:
                positional += _words(name, value)
        else:
            options += _option(name, value, parameter.default)
    if any(word.startswith("-") for word in positional):
        return shlex.join([PROGRAM, *names_of(function), *options, "--", *positional])
    return shlex.join([PROGRAM, *names_of(function), *positional, *options])


def parsed(line: str) -> list[tuple[Callable[..., Any], dict[str, Any]]]:
    """The functions that a line's commands run, one after another, with all their arguments; runs nothing.

    Raises:
        ValueError: the line is no command of `doojax`, or has options that the command does not take.
    """
    try:
        words = shlex.split(line)
    except ValueError as error:
        raise ValueError(f"{line!r} cannot be read: {error}") from error
    parts: list[list[str]] = [[]]
    for word in words:
        if word == AND:
            parts.append([])
        else:
            parts[-1].append(word)
    return [_parsed(part) for part in parts]


def _parsed(words: Sequence[str]) -> tuple[Callable[..., Any], dict[str, Any]]:
    import tyro  # here, so that the list of commands appears at once

    if not words or words[0] != PROGRAM:
        raise ValueError(f"{shlex.join(words)!r} is no command: it should begin with {PROGRAM}")
    target: str | Commands = COMMANDS
    rest = list(words[1:])
    while not isinstance(target, str):
        name, rest = first_name(rest, target)
        if name not in target:
            raise ValueError(f"{shlex.join(words)!r} names no command of: {', '.join(target)}")
        target = target[name][0]
    function = load(target)

    @functools.wraps(function)
    def given(*positional: Any, **named: Any) -> dict[str, Any]:
        bound = inspect.signature(function).bind(*positional, **named)
        bound.apply_defaults()
        return bound.arguments

    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint), redirect_stdout(complaint):
            return function, tyro.cli(given, args=rest)
    except SystemExit as stop:
        said = " ".join(complaint.getvalue().replace("│", " ").split())
        raise ValueError(f"{shlex.join(words)!r} is not understood: {said}") from stop


def _option(name: str, value: Any, default: Any) -> list[str]:
    """The words that give an option its value: none where that is the default."""
    if is_dataclass(value) and not isinstance(value, type):
        if not isinstance(default, type(value)):
            raise ValueError(f"{name} has no default of type {type(value).__name__} to compare it with")
        inner = [
            _option(f"{name}.{one.name}", getattr(value, one.name), getattr(default, one.name))
            for one in fields(value)
        ]
        return [word for words in inner for word in words]
    if value == default and isinstance(value, bool) == isinstance(default, bool):
        return []
    flag = f"--{name}".replace("_", "-")
    if isinstance(value, bool) and isinstance(default, bool):
        return [flag if value else f"--{name.replace('_', '-')}".replace("--", "--no-", 1)]
    words = _words(name, value)
    if len(words) == 1 and words[0].startswith("-"):
        return [f"{flag}={words[0]}"]
    return [flag, *words]


def _words(name: str, value: Any) -> list[str]:
    """A value, as a user would type it."""
    if isinstance(value, tuple):
        words = [word for item in value for word in _words(name, item)]
        if any(word.startswith("-") and not _is_number(word) for word in words):
            raise ValueError(f"{name} is {value}: in a list no word may begin with a dash")
        return words
    if isinstance(value, str | Path):
        if str(value) in ("None", AND):
            raise ValueError(f"{name} is {str(value)!r}, which stands for something else on a command line")
        return [str(value)]
    if value is None or isinstance(value, bool | int | float):
        return [str(value)]
    raise ValueError(f"{name} is of type {type(value).__name__}, which no command line gives")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
