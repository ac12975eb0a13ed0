"""What an evaluation found: tables like 2.1 and 2.2 of the thesis, a figure like 2.6, paired tests."""

import csv
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Column, Table

from doojax.commands import AND, command_line
from doojax.experiments.reports.provenance import noted_commands
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import (
    Estimate,
    PairedTest,
    bootstrap,
    mcnemar,
    permutation,
    signed_rank,
    success_curve,
    success_rate,
)
from doojax.experiments.reports.summary import publish_rows, row
from doojax.experiments.reports.tables import cells
from doojax.experiments.trials.executed import wrong_among_accepted
from doojax.experiments.trials.outcomes import COUNTS, SCENES, Outcomes, read_evaluation
from doojax.experiments.trials.scenes import FOLDER, SceneSet, load_scenes
from doojax.experiments.trials.setting import TrialSettings
from doojax.experiments.trials.trial import CRASHED
from doojax.files import file_digest, write_whole

ORACLE = "oracle"
TESTS: dict[str, Callable[[Outcomes, Outcomes], PairedTest]] = {
    "mcnemar": lambda a, b: mcnemar(a.success, b.success),
    "signed_rank": lambda a, b: signed_rank(a.error, b.error),
    "permutation": lambda a, b: permutation(a.error, b.error),
}
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999")
DASHES = ("-", "--", ":", "-.")
FARTHEST = 0.25  # m, of the thresholds in the figure


def compare(folder: Path, /, *, out: Path | None = None, publish: Path | None = None) -> None:
    """Tables, a figure and paired tests of an evaluation's methods, on the scenes that all of them tried.

    Writes comparison.md, methods.csv, tests.csv, trials.csv and success.png.

    Args:
        folder: what doojax evaluate wrote.
        out: where to write; by default the evaluation's folder "comparison".
        publish: the folder of results whose summary.json gets the figures, too, such as results/planning.

    Raises:
        FileNotFoundError: there is no evaluation in the folder.
        ValueError: there is no finished trial, the methods have no scene in common, or figures are to be
            published of an evaluation that does not say by which command it was made.
    """
    own = command_line(compare, locals())
    config, outcomes = read_evaluation(folder)
    made = noted_commands(folder)
    if publish is not None and not made:
        raise ValueError(f"{folder} does not say by which command it was made: evaluate anew to publish it")
    command = f" {AND} ".join([*dict.fromkeys(run.command for run in made), own])
    out = out or folder / "comparison"
    out.mkdir(parents=True, exist_ok=True)
    task = str(config["task"])
    scenes = load_scenes(folder / SCENES)
    sizes, kind = scenes.sizes, "scenes where the rope is caught" if scenes.caught else "scenes"
    tables = {"methods": method_table(outcomes), "tests": pair_table(outcomes)}
    for name, lines in tables.items():
        _write_csv(out / f"{name}.csv", lines)
    _write_csv(out / "trials.csv", trial_table(outcomes, sizes))
    scene_lines, end_lines = scene_table(outcomes, sizes), end_table(outcomes)
    trials, failures = len(outcomes[0].trials), why_table(outcomes)
    text = "\n".join(
        [
            f"# {task}: {len(outcomes)} methods on {trials} {kind}",
            "",
            f"Scenes: {scenes.rule}.",
            "",
            f"Made by `{command}`, seed {config['seed']}.",
            "",
            *_markdown(tables["methods"]),
            "",
            f"Success: the goal's point ends within {100 * outcomes[0].goal_radius:.0f} cm of the goal, with "
            "Wilson's interval. Errors in metres; intervals of 95 % by bootstrap.",
            "",
            *(f"**{line}**\n" for line in crash_lines(outcomes)),
            *(("## Paired tests", "", *_markdown(tables["tests"]), "") if len(outcomes) > 1 else ()),
            "## Scenes",
            "",
            *_markdown(scene_lines),
            "",
            "## How trials ended",
            "",
            *_markdown(end_lines),
            *(("", "## Why trials failed", "", *_markdown(failures)) if len(failures) > 1 else ()),
        ]
    )
    write_whole(out / "comparison.md", text + "\n")
    draw_success(out / "success.png", outcomes, f"{task.replace('_', ' ')}, {trials} {kind}")
    about = scene_tags(task, scenes, config.get("scenes")) | setting_tags(config)
    rows = summary_rows(about, outcomes)
    inputs = {name: value for run in made for name, value in run.inputs.items()}
    last = made[-1] if made else None
    publish_rows(publish, command=command, seed=int(config["seed"]), rows=rows, inputs=inputs, measured=last)
    show_briefly(outcomes, f"{task}: {trials} {kind}")
    for line in crash_lines(outcomes):
        Console(stderr=True, markup=False, highlight=False).print(line, style="red", soft_wrap=True)
    Console(stderr=True).print(f"all tables and the figure are in {out}", highlight=False, markup=False)


def scene_tags(task: str, scenes: SceneSet, digest: str | None) -> dict[str, Any]:
    """What rows say of the scenes of their trials; of a set that does not come with doojax, its seed, too.

    Args:
        task: whose.
        scenes: the set.
        digest: of its file, as an evaluation's config has it.
    """
    tags: dict[str, Any] = {"task": task, "difficulty": scenes.difficulty}
    tags |= {"start": "caught"} if scenes.caught else {}
    if scenes.rope.given:
        tags["rope"] = ",".join(f"{name}={value}" for name, value in scenes.rope.given.items())
    if digest is not None and digest not in (file_digest(path)[:16] for path in FOLDER.glob("*.scenes")):
        tags["scene_seed"] = scenes.seed
    return tags


def setting_tags(config: dict[str, Any]) -> dict[str, Any]:
    """What rows say of an evaluation's settings: those that are not the default."""
    plain, budget = asdict(TrialSettings()), config.get("budget", {})
    tags = {name: budget[name] for name in plain if name in budget and budget[name] != plain[name]}
    return tags | {name: config[name] for name in ("accept", "margin") if config.get(name) is not None}


def show_briefly(outcomes: Sequence[Outcomes], title: str) -> None:
    """Print what fits on a terminal."""
    heads = ("method", "success", "mean\n(m)", "median\n(m)", "recovery\nactions", "planning")
    columns = (Column(head, no_wrap=True) for head in heads)  # all of it in a terminal of 80 columns
    table = Table(*columns, title=title, box=SIMPLE_HEAD, pad_edge=False)
    for one in outcomes:
        figures = (f"{one.error.mean():.3f}", f"{np.median(one.error):.3f}")
        recoveries = str(one.counts["recovery_actions"].sum())
        table.add_row(
            one.method,
            _percent(success_rate(one.success)),
            *figures,
            recoveries,
            f"{one.plan_s.mean():.2f} s",
        )
    Console().print(table)


def method_table(outcomes: Sequence[Outcomes]) -> list[list[str]]:
    """Heads and one line a method."""
    heads = ["method", "success", "max (m)", "mean (m)", "median (m)", "std (m)"]
    lines = [[*heads, "searches", "extensions", "actions", "recovery actions", "planning (s)", "minutes"]]
    for one in outcomes:
        mean, median = bootstrap(one.error), bootstrap(one.error, np.median)
        lines.append(
            [
                one.method,
                _percent(success_rate(one.success)),
                f"{one.error.max():.3f}",
                _metres(mean),
                _metres(median),
                f"{one.error.std():.3f}",
                *(f"{one.counts[name].mean():.1f}" for name in ("searches", "extensions", "actions")),
                str(one.counts["recovery_actions"].sum()),
                f"{one.plan_s.mean():.2f}",
                f"{one.minutes:.1f}",
            ]
        )
    return lines


def pair_table(outcomes: Sequence[Outcomes]) -> list[list[str]]:
    """Heads and one line a pair of methods: differences are the first less the second."""
    lines = [["method", "against", "success", "p (McNemar)", "median error", "p (signed rank)"]]
    lines[0] += ["mean error", "p (permutation)"]
    for first, second in combinations(outcomes, 2):
        found = [test(first, second) for test in TESTS.values()]
        shown = [_percent(found[0].difference), *(f"{_metres(test.difference)}" for test in found[1:])]
        pairs = zip(shown, (f"{test.p_value:.2g}" for test in found), strict=True)
        lines.append([first.method, second.method, *(text for pair in pairs for text in pair)])
    return lines


def scene_table(outcomes: Sequence[Outcomes], sizes: dict[str, np.ndarray]) -> list[list[str]]:
    """Heads and one line a measure of difficulty; success on its harder and easier half of the scenes."""
    trials = outcomes[0].trials
    lines = [["measure", "mean (m)", "least", "greatest", *(f"{one.method} (low, high)" for one in outcomes)]]
    for name, values in sizes.items():
        own = values[trials]
        low = own <= np.median(own)
        halves = [f"{_rate(one.success[low])}, {_rate(one.success[~low])}" for one in outcomes]
        figures = [_metres(bootstrap(own)), f"{own.min():.3f}", f"{own.max():.3f}"]
        lines.append([name.replace("_", " "), *figures, *halves])
    oracle = next((one for one in outcomes if one.method == ORACLE), None)
    if oracle is not None and oracle.success.any():
        solved = [_rate(one.success[oracle.success]) for one in outcomes]
        rate = _percent(success_rate(oracle.success))
        lines.append(["solved by the oracle", rate, "", "", *solved])
    return lines


def end_table(outcomes: Sequence[Outcomes]) -> list[list[str]]:
    """Heads and one line a reason, most frequent first."""
    counts = [Counter(one.ends) for one in outcomes]
    reasons = sum(counts, Counter()).most_common()
    lines = [["end", *(one.method for one in outcomes)]]
    return lines + [[reason, *(str(count[reason]) for count in counts)] for reason, _ in reasons]


def why_table(outcomes: Sequence[Outcomes]) -> list[list[str]]:
    """Heads and one line a failed trial, by scene."""
    failed = [
        (int(trial), one.method, f"{one.error[i]:.3f}", one.whys[i])
        for one in outcomes
        for i, trial in enumerate(one.trials)
        if not one.success[i]
    ]
    failed.sort(key=lambda line: line[0])
    return [["scene", "method", "error (m)", "why"], *([str(trial), *rest] for trial, *rest in failed)]


def crash_lines(outcomes: Sequence[Outcomes]) -> list[str]:
    """One line for every method of which trials crashed: those are no findings about it."""
    lines = []
    for one in outcomes:
        count = sum(end.startswith(CRASHED) for end in one.ends)
        if count:
            lines.append(
                f"{count} of {len(one.ends)} trials of {one.method} crashed and count as failures: delete "
                "their records and evaluate again."
            )
    return lines


def trial_table(outcomes: Sequence[Outcomes], sizes: dict[str, np.ndarray]) -> list[list[str]]:
    """Heads and one line a trial."""
    lines = [["method", "trial", "success", "final_error_m", "plan_s", *COUNTS, "end", "why", *sizes]]
    for one in outcomes:
        for i, trial in enumerate(one.trials.tolist()):
            counted = [str(one.counts[name][i]) for name in COUNTS]
            measures = [f"{values[trial]:.4f}" for values in sizes.values()]
            figures = [f"{one.error[i]:.5f}", f"{one.plan_s[i]:.3f}"]
            start = [one.method, str(trial), str(bool(one.success[i])), *figures]
            lines.append([*start, *counted, one.ends[i], one.whys[i], *measures])
    return lines


def summary_rows(about: dict[str, str], outcomes: Sequence[Outcomes]) -> list[Row]:
    """The figures for a summary.json, tagged with ``about``."""
    rows = []
    for one in outcomes:
        tags, n = about | {"method": one.method}, len(one.trials)
        recoveries = bootstrap(one.counts["recovery_actions"].astype(float))
        total = Estimate(n * recoveries.value, n * recoveries.low, n * recoveries.high, n)
        figures = {
            "success_rate": (success_rate(one.success), ""),
            "final_error_mean_m": (bootstrap(one.error), "m"),
            "final_error_median_m": (bootstrap(one.error, np.median), "m"),
            "recovery_actions": (total, ""),
            "plan_s": (bootstrap(one.plan_s), "s"),
        }
        if one.volumes is not None:
            parts = dict(zip(("poured", "spilled"), one.volumes.T, strict=True))
            figures |= {name: (bootstrap(values), "") for name, values in parts.items()}
        rows += [row(name, tags, e.value, unit, e.low, e.high, e.n) for name, (e, unit) in figures.items()]
        rows.append(row("evaluate_minutes", tags, one.minutes, "min", n=n))
        if wrong := wrong_among_accepted(one.judged):
            rows.append(row("wrong_among_accepted", tags, wrong.value, "", wrong.low, wrong.high, wrong.n))
        if one.method == ORACLE:
            e = success_rate(one.success)
            rows.append(row("oracle_success", about | {"scenes": n}, e.value, "", e.low, e.high, e.n))
    for first, second in combinations(outcomes, 2):
        for name, test in TESTS.items():
            tags = about | {"test": name, "method": first.method, "against": second.method}
            rows.append(row("p_value", tags, test(first, second).p_value, "", n=len(first.trials)))
    return rows


def draw_success(path: Path, outcomes: Sequence[Outcomes], title: str) -> None:
    """The rate of success against the threshold on the final error, with 95 % intervals (thesis Fig. 2.6)."""
    FigureCanvasAgg(success_figure(outcomes, title)).print_png(path)


def success_figure(outcomes: Sequence[Outcomes], title: str) -> Figure:
    """One curve for every method, however many there are: beyond the colours, the dashes differ."""
    thresholds = np.linspace(0.0, FARTHEST, 126)
    figure = Figure(figsize=(7.2, 4.4), dpi=150)
    axes = figure.add_subplot()
    best_first = sorted(outcomes, key=lambda one: -one.success.mean())
    for number, one in enumerate(best_first):
        colour, dashes = COLOURS[number % len(COLOURS)], DASHES[number // len(COLOURS) % len(DASHES)]
        low, high = curve_interval(one.error, thresholds)
        name = f"{one.method.replace('_', ' ')} ({100 * one.success.mean():.0f} %)"
        axes.plot(
            100 * thresholds,
            100 * success_curve(one.error, thresholds),
            color=colour,
            linestyle=dashes,
            label=name,
            lw=1.8,
        )
        axes.fill_between(100 * thresholds, 100 * low, 100 * high, color=colour, alpha=0.12, lw=0)
    axes.axvline(100 * outcomes[0].goal_radius, color="#555555", linestyle="--", linewidth=1)
    axes.set(xlim=(0, 100 * FARTHEST), ylim=(0, 101), title=title)
    axes.set(xlabel="threshold on the final error (cm)", ylabel="trials below it (%)")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, loc="lower right", fontsize=9)
    figure.tight_layout()
    return figure


def curve_interval(
    errors: Float[np.ndarray, "n"], thresholds: Float[np.ndarray, "k"]
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Wilson's 95 % interval of the success curve at each threshold."""
    ends = [success_rate(errors <= threshold)[1:3] for threshold in thresholds]
    low, high = np.array(ends).T
    return low, high


def _markdown(lines: Sequence[Sequence[str]]) -> list[str]:
    ruler = cells([":--", *("--:" for _ in lines[0][1:])])
    return [cells(lines[0]), ruler, *(cells(line) for line in lines[1:])]


def _write_csv(path: Path, lines: Sequence[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)


def _rate(success: np.ndarray) -> str:
    return f"{100 * success.mean():.0f} %" if len(success) else "-"


def _percent(estimate: Estimate) -> str:
    value, low, high = (100 * x for x in estimate[:3])
    return f"{value:.1f} % ({low:.0f} to {high:.0f})"


def _metres(estimate: Estimate) -> str:
    return f"{estimate.value:.3f} ({estimate.low:.3f} to {estimate.high:.3f})"
