"""What adapting to what is alike is worth: `doojax adaptation-study` (thesis section 4.4.3).

Dynamics are learned from a source, the task's own rope without obstacles, and adapted to a target, another
rope among obstacles. Each seed has a network and adaptation data of its own; each method adapts that network
to those data, in equally many steps; all are measured on the same trajectories, whose scenes none has seen.
What of them is alike is said by geometry alone: where rope and hands keep clear of all obstacles.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from rich.console import Console

from doojax.commands import command_line
from doojax.datasets.collect import collect
from doojax.experiments.reports.provenance import digests
from doojax.experiments.reports.summary import publish_rows, show
from doojax.experiments.sweeps.adaptation_figures import Measured, draw_weights, study_rows
from doojax.experiments.sweeps.sources import Counts, all_splits, require_study, seed_of, source_models
from doojax.experiments.training.deviation import DeviationFigures, deviation_figures
from doojax.experiments.training.train import training_progress
from doojax.keys import check_seed
from doojax.learning.adaptation import (
    METHODS,
    AdaptationConfig,
    AdaptationMethod,
    adapt,
    similarity_threshold,
)
from doojax.learning.data import Trajectories, load_split, open_dataset
from doojax.learning.deviation import (
    DeviationConfig,
    DeviationExamples,
    calibrated,
    deviation_examples,
    deviations,
    fit_deviation,
)
from doojax.learning.fit import FitConfig, Report, member
from doojax.learning.pieces import Pieces, chunked, cut, step_errors
from doojax.learning.presets import deviation_preset
from doojax.learning.runs import RunDirectory
from doojax.learning.train import ALPHAS, BIAS
from doojax.models import CollisionChecker
from doojax.tasks import make_task
from doojax.tasks.ropes import OWN, OtherRope
from doojax.types import Transition

TASK = "dual_gripper"
PAIRS = {  # target ropes, by name; the source is the task's own
    "stiff": OtherRope(bending_stiffness=0.032, bending_damping=0.0032),
    "mild": OtherRope(bending_stiffness=0.004),
}
STATES = 20  # of a trajectory among obstacles
SHARES = {"validation": 16, "calibration": 48, "test": 64}  # trajectories of each pair that all seeds share
BATCH = 32  # pieces
FREE = 48  # trajectories without obstacles by which a pair is judged
CLEAR = 0.02  # m, that the rope's axis and the hands keep from all obstacles where dynamics are alike


@dataclass(frozen=True)
class StudySettings(Counts):
    """How much is collected and how long is trained."""

    source_trajectories: int = 1024  # without obstacles, of the source's rope
    trajectories: int = 48  # among obstacles, of the target's rope, for each seed
    source_epochs: int = 60
    epochs: int = 60  # of adaptation
    deviation_epochs: int = 10


SETTINGS = StudySettings()


def adaptation_study(
    *,
    out: Path,
    pairs: tuple[str, ...] = tuple(PAIRS),
    methods: tuple[AdaptationMethod, ...] = METHODS,
    seeds: int = 5,
    settings: StudySettings = SETTINGS,
    seed: int = 0,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Adapt dynamics from one rope to another among obstacles by several methods, and compare.

    Killed, it goes on where it was when the same command is given again.

    Args:
        out: the folder of data and training runs; new, empty, or the same study unfinished.
        pairs: target ropes by name: stiff, mild.
        methods: focus, all_data, low_initial_error, hard_initial_error; what is not adapted is always there.
        seeds: source networks, and sets of adaptation data.
        settings: how much is collected and how long is trained.
        seed: of everything that is random.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, and its pictures; by default they
            are only shown, and drawn into ``out``.

    Raises:
        ValueError: for an unknown pair or method, a count below 1, or a folder that holds something else.
    """
    check_seed(seed)
    command = command_line(adaptation_study, locals())
    require_study(methods, seeds, pairs=(pairs, PAIRS))
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    inputs = {"source": out / "source"}
    collected(inputs["source"], "unconstrained", settings.source_trajectories, OWN, seed, "source")
    with training_progress(console, "source") as report:
        sources = source_models(out, make_task(TASK), seeds, settings.source_epochs, seed, report)
    found: dict[str, list[Measured]] = {}
    for pair in pairs:
        data = pair_data(out / pair, pair, seeds, settings, seed)
        inputs |= {f"{pair} {name}": out / pair / name for name in data}
        with training_progress(console, pair) as report:
            found[pair] = [
                studied(out, pair, methods, number, member(sources, number), data, settings, seed, report)
                for number in range(seeds)
            ]
    rows = study_rows(TASK, found)
    for pair, of_seeds in found.items():
        draw_weights((publish or out) / f"weights_{pair}.png", of_seeds, f"{TASK}, {pair} rope")
    publish_rows(publish, command=command, seed=seed, rows=rows, inputs=digests(inputs))
    show(rows, json)


def pair_data(
    folder: Path, pair: str, seeds: int, settings: StudySettings, seed: int
) -> dict[str, Trajectories]:
    """All of a target rope's data: a set for each seed, what seeds share, and what has no obstacles."""
    rope, counts = PAIRS[pair], {f"set{number}": settings.trajectories for number in range(seeds)} | SHARES
    found = {
        name: collected(folder / name, "constrained", count, rope, seed, pair, name)
        for name, count in counts.items()
    }
    return found | {"free": collected(folder / "free", "unconstrained", FREE, rope, seed, pair, "free")}


def studied(
    out: Path,
    pair: str,
    methods: tuple[AdaptationMethod, ...],
    number: int,
    source: Any,
    shared: dict[str, Trajectories],
    settings: StudySettings,
    seed: int,
    report: Report,
) -> Measured:
    """All methods for one target rope and one seed."""
    home, data, folder = open_dataset(out / "source"), shared[f"set{number}"], out / pair
    base = AdaptationConfig(fit=FitConfig(settings.epochs, BATCH, keep="last"))
    capacity = settings.trajectories * -(
        -(STATES - 1) // base.horizon
    )  # pieces, if no trajectory has a fault
    base = replace(base, steps=max(1, capacity // BATCH))
    gamma = similarity_threshold(source, load_split(home, "calibration"), base)
    pieces = cut(shared["test"], base.horizon)
    alike = clear_steps(pieces)
    dynamics, weights = {"none": source}, {}
    for method in methods:
        config = replace(base, method=method)
        path = folder / f"seed{number}" / method
        run = opened(path, {"config": asdict(config), "gamma_m": gamma, "seed": seed}, out, pair, number)
        options: dict[str, Any] = {"seed": seed + number, "capacity": capacity, "run": run, "report": report}
        adapted = adapt(source, data, gamma, config, **options)
        dynamics[method], weights[method] = adapted.dynamics, run.metrics
    errors = {method: step_errors(model, pieces) for method, model in dynamics.items()}
    best = dynamics.get("focus", source)
    run = opened(folder / f"seed{number}" / "deviation", {"seed": seed}, out, pair, number)
    estimated = deviation_of(best, data, shared, gamma, settings, seed + number, run, report)
    return Measured(
        gamma=gamma,
        home=float(np.nanmean(step_errors(source, cut(load_split(home, "test"), base.horizon)))),
        away=float(np.nanmean(step_errors(source, cut(shared["free"], base.horizon)))),
        errors=errors,
        alike=alike,
        there=np.asarray(pieces.there),
        trajectory=np.asarray(pieces.origin),
        epochs=weights,
        deviation=estimated,
    )


def deviation_of(
    dynamics: Any,
    data: Trajectories,
    shared: dict[str, Trajectories],
    limit: float,
    settings: StudySettings,
    seed: int,
    run: RunDirectory,
    report: Report,
) -> DeviationFigures:
    """An estimator of how far off dynamics are, from the same data, measured on the test trajectories."""
    task = make_task(TASK)
    chosen = deviation_preset("quick", task)
    fitting = replace(chosen.fit, epochs=settings.deviation_epochs)
    config = DeviationConfig(chosen.network, bias=BIAS * float(np.sqrt(task.scene.links)), fit=fitting)

    def examples(of: Trajectories) -> DeviationExamples:
        return deviation_examples(dynamics, of, horizon=config.horizon)

    model = fit_deviation(
        examples(data), examples(shared["validation"]), config, seed=seed, run=run, report=report
    )
    model, factors = calibrated(model.limited(limit), examples(shared["calibration"]), ALPHAS)
    test = examples(shared["test"])
    return deviation_figures(
        deviations(model, test), np.asarray(test.deviation), np.asarray(test.trajectory), factors
    )


def collected(folder: Path, phase: Any, count: int, rope: OtherRope, seed: int, *names: str) -> Trajectories:
    """Sound trajectories of a purpose's own: no scene and no action is one of another purpose's."""
    states = STATES if phase == "constrained" else None
    collect(
        TASK,
        phase=phase,
        trajectories=count,
        states=states,
        engine="mujoco",
        seed=seed_of(seed, *names),
        rope=rope,
        out=folder,
    )
    return all_splits(folder)


def opened(path: Path, about: dict[str, Any], out: Path, pair: str, number: int) -> RunDirectory:
    """The run of one training, with digests of what it learns from."""
    data = {"source": out / "source", "set": out / pair / f"set{number}"}
    return RunDirectory.open(path, about | digests(data))


def clear_steps(pieces: Pieces) -> Bool[np.ndarray, "n H"]:
    """Which steps are alike: up to their end, since the piece began, rope and hands kept `CLEAR`, on their
    straight ways from state to state and at each of them."""
    clear = chunked(_distances, CollisionChecker(), pieces.trajectories) > CLEAR
    return np.logical_and.accumulate(clear, axis=1) & np.asarray(pieces.there)


@eqx.filter_jit
def _distances(checker: CollisionChecker, data: Trajectories) -> Float[Array, "n H"]:
    def one(piece: Trajectories) -> Float[Array, "H"]:
        before = jax.tree.map(lambda leaf: leaf[:-1], piece.states)
        after = jax.tree.map(lambda leaf: leaf[1:], piece.states)
        steps = Transition(before, piece.actions, after, jnp.zeros(len(piece.actions)))
        return jax.vmap(checker.distance, (None, 0))(piece.obstacles, steps)

    return jax.vmap(one)(data)
