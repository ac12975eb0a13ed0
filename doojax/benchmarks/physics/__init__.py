"""How right the physics is: closed forms beside what every engine makes of them, with every task's solver.

`doojax.benchmarks.physics.closed_forms` holds the closed forms and their sources; each group of cases has a
file of its own.
"""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console

from doojax.benchmarks.physics import table
from doojax.benchmarks.physics.cases import TASKS, Finding, Settings
from doojax.benchmarks.physics.contact import capstan, edge, plates
from doojax.benchmarks.physics.engines import SEED, random_data
from doojax.benchmarks.physics.fall import fall
from doojax.benchmarks.physics.friction import friction
from doojax.benchmarks.physics.statics import cantilevers, catenaries, clamped_scene, holding, twists
from doojax.benchmarks.physics.swing import swing
from doojax.commands import command_line
from doojax.experiments.reports.summary import publish_rows, show
from doojax.simulation.engines import resolve_engine

__all__ = ["clamped_scene", "physics"]

Group = Callable[[Settings, str], Iterator[Finding]]

# A group's cases, and the tasks whose settings they are for.
SPATIAL, ALL = ("dual_gripper", "default"), TASKS
GROUPS: dict[str, tuple[Group, tuple[str, ...]]] = {
    "swing": (swing, SPATIAL),
    "fall": (fall, SPATIAL),
    "friction": (friction, ALL),
    "catenary": (catenaries, SPATIAL),
    "cantilever": (cantilevers, SPATIAL),
    "twist": (twists, SPATIAL),
    "holding": (holding, SPATIAL),
    "capstan": (capstan, SPATIAL),
    "edge": (edge, SPATIAL),
    "plates": (plates, SPATIAL),
    "random": (random_data, ("rope_dragging", "dual_gripper")),
}


def physics(
    groups: tuple[str, ...] = (),
    /,
    *,
    engines: tuple[str, ...] = ("mujoco",),
    tasks: tuple[str, ...] = TASKS,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Measure how far ropes are from closed forms, ropes inside obstacles, and engines from each other.

    Each group runs with the solver and time step of each task that it concerns, and with a converged solver
    at the same time step: what is wrong in both is the model's fault.

    Args:
        groups: which cases: swing, fall, friction, catenary, cantilever, twist, holding, capstan, edge,
            plates, random; all of them by default.
        engines: some of mujoco, mjx and warp. MJX compiles for up to a minute per scene.
        tasks: whose settings: rope_dragging, dual_gripper, or default for those of a plain scene.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/physics; by
            default they are only shown.

    Raises:
        ValueError: for an unknown group, task or engine.
        ModuleNotFoundError: for an engine that is not installed.
    """
    command = command_line(physics, locals())
    engines = tuple(map(resolve_engine, engines))
    groups = groups or tuple(GROUPS)
    for name, known, what in ((groups, GROUPS, "group"), (tasks, TASKS, "task")):
        unknown = [one for one in name if one not in known]
        if unknown:
            raise ValueError(f"unknown {what} {unknown[0]!r}, expected one of {', '.join(known)}")
    console, findings, begun = Console(stderr=True), [], time.perf_counter()
    for name in groups:
        run, concerned = GROUPS[name]
        for task in (one for one in tasks if one in concerned):
            for engine in engines:
                for settings in every_settings(task, engine):
                    for finding in run(settings, engine):
                        findings.append(finding)
                        passed = time.perf_counter() - begun
                        console.print(
                            f"{passed:5.0f} s  {table.line(finding)}", highlight=False, soft_wrap=True
                        )
    if not findings:
        raise ValueError(f"none of the groups {', '.join(groups)} concerns the tasks {', '.join(tasks)}")
    rows = list(table.rows(findings))
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    if json:
        show(rows, json)
    else:
        table.show(findings)


def every_settings(task: str, engine: str) -> tuple[Settings, ...]:
    """As the task has them and, where that is no matter of hours, converged."""
    return (Settings(task), Settings(task, converged=True)) if engine == "mujoco" else (Settings(task),)
