"""Learn which transforms of a task's examples are valid: `doojax train validity`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.console import Console

from doojax.augmentation.command import Way
from doojax.augmentation.examples import Bounds
from doojax.augmentation.validity import EXAMPLES, TransformErrors, transform_errors, usual_count
from doojax.commands import command_line
from doojax.experiments.reports.provenance import digests, note_command
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.experiments.training.train import training_progress
from doojax.files import alone_in, whole_file
from doojax.keys import check_seed
from doojax.learning.checkpoints import Header, load_model
from doojax.learning.fit import fit, member
from doojax.learning.runs import RunDirectory
from doojax.learning.validity import ValidityProblem, validity_fit
from doojax.models.validity import TransformValidity, ValidityConfig
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.tasks.ropes import OWN, OtherRope, with_rope

KIND, TRIED = "validity", "tried.npz"
VALIDATION = 5  # of so many transforms one is for validation
SHOWN = (15, 30, 60, 90)  # degrees about an axis, whose errors are told
TRANSLATION, ROTATION = (0.25, 0.25, 0.25), (1.6, 1.6, 1.6)


def train_validity(
    task: str,
    /,
    *,
    out: Path,
    transforms: int | None = None,
    translation: Way = TRANSLATION,
    rotation: Way = ROTATION,
    limit: float = 0.02,
    epochs: int = 100,
    engine: str = "auto",
    seed: int = 0,
    rope: OtherRope = OWN,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Learn from the simulator how far an example that was moved rigidly comes out from where it should.

    Transforms of growing size are tried on examples with nothing in their way (the thesis's algorithm 3), and
    a small network learns the error from the transform alone. `doojax augment --validity` then refuses
    transforms whose error is above the limit, as that of a limp rope that is laid on its side.

    Args:
        task: rope_dragging, dual_gripper or another whose examples are ropes.
        out: the run's folder; new, empty, or the same run unfinished.
        transforms: how many are tried; by default the thesis's 10^(d/2), of d dimensions.
        translation: m, of the largest transforms, either way along each axis.
        rotation: rad, of the largest, either way, rotation vector.
        limit: m, root mean square over an example's points; what errs by less is valid.
        epochs: of training.
        engine: mujoco, mjx, warp or auto.
        seed: of everything that is random.
        rope: what of the rope differs from the task's own.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures; by default they are only shown.

    Raises:
        ValueError: for a task without a rope, counts or a limit out of range, or a folder that holds another
            run.
    """
    check_seed(seed)
    command = command_line(train_validity, locals())
    the_task = with_rope(make_task(task, phase="unconstrained"), rope)
    if the_task.scene.cylinders:
        raise ValueError(f"{task} has no rope: in its plane every transform is valid")
    if not limit > 0:
        raise ValueError(f"limit is {limit}, expected more than 0 m")
    bounds = Bounds(translation, rotation)
    count = usual_count(bounds) if transforms is None else transforms
    if count < 2 * VALIDATION:
        raise ValueError(f"transforms is {count}, expected at least {2 * VALIDATION}")
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    config = {"what": KIND, "task": task, "rope": rope.given, "transforms": count, "engine": engine}
    config |= {"seed": seed, "limit": limit, "epochs": epochs, **asdict(bounds)}
    with alone_in(out):
        run = RunDirectory.open(out, config)
        if not run.finished:
            tried = _tried(out / TRIED, the_task, engine, bounds, count, seed, console)
            model = _learned(tried, epochs, seed, run, console).limited(limit)
            about = {"rope": rope.given, "seed": seed, **_found(tried, model)}
            run.finish(Header(KIND, task, asdict(ValidityConfig()), about), model)
    model, header = load_model(out, task=task, kind=KIND)
    note_command(out, command, seed, {})
    rows = _rows(task, rope, model, header)
    publish_rows(publish, command=command, seed=seed, rows=rows, inputs=digests({"validity": out}))
    show(rows, json)


def _tried(
    file: Path, task: Task, engine: str, bounds: Bounds, count: int, seed: int, console: Console
) -> TransformErrors:
    """What the simulator does with each transform; in ``file`` for a run that goes on, and for who looks."""
    if not file.exists():
        console.print(f"{count} transforms of {task.name}, each tried on {EXAMPLES} examples", style="dim")
        found = transform_errors(task, task.simulator(engine), bounds, count, seed)
        with whole_file(file) as opened:
            np.savez_compressed(opened, **found._asdict())
    with np.load(file, allow_pickle=False) as stored:
        return TransformErrors(**stored)


def _learned(
    tried: TransformErrors, epochs: int, seed: int, run: RunDirectory, console: Console
) -> TransformValidity:
    """Every fifth transform validates, so that small and large ones do."""
    held_out = np.arange(len(tried.errors)) % VALIDATION == VALIDATION - 1
    transforms, errors = (jnp.asarray(value) for value in tried)
    problem = ValidityProblem(
        transforms[~held_out], errors[~held_out], (transforms[held_out], errors[held_out]), ValidityConfig()
    )
    with training_progress(console, KIND) as report:
        config = validity_fit(int((~held_out).sum()), epochs)
        return member(fit(problem, config, seed=seed, run=run, report=report), 0)


def _found(tried: TransformErrors, model: TransformValidity) -> dict[str, Any]:
    """How many of what was tried are valid, in truth; see `Header.about`."""
    return {"tried": len(tried.errors), "valid_fraction": float((tried.errors < float(model.limit)).mean())}


def _rows(task: str, rope: OtherRope, model: TransformValidity, header: Header) -> list[Row]:
    """What the network says of turns about each axis."""
    own = ",".join(f"{name}={value:g}" for name, value in rope.given.items())
    tags = {"task": task, **({"rope": own} if own else {})}
    rows = [row("valid_fraction", tags, header.about["valid_fraction"], "", n=header.about["tried"])]
    for axis, name in enumerate("xyz"):
        for degrees in SHOWN:
            turn = jnp.zeros(6).at[3 + axis].set(np.deg2rad(degrees))
            rows.append(
                row("transform_error_m", tags | {"about": name, "degrees": degrees}, model.error(turn), "m")
            )
    return rows
