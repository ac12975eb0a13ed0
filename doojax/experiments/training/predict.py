"""`doojax predict`: what a model expected along recorded trajectories, for `doojax view`."""

from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from rich.console import Console

from doojax.commands import command_line
from doojax.experiments.reports.provenance import digests
from doojax.experiments.trials.judges import UNLEARNED, name_of_score, threshold_of
from doojax.experiments.trials.record_files import save_record
from doojax.experiments.trials.records import Look, PredictionRecord
from doojax.learning.checkpoints import Header, load_model
from doojax.learning.data import Trajectories, load_split, open_dataset
from doojax.models.protocols import Dynamics, Reliability
from doojax.models.rolling import roll_out
from doojax.tasks.ropes import task_of
from doojax.types import Transition

DYNAMICS, JUDGES = ("dynamics", "full_dynamics"), ("classifier", "voxel_classifier")
AT_ONCE = 256  # predictions side by side


class Predictions(NamedTuple):
    """P predictions of H steps, each from a true state on."""

    bodies: Float[np.ndarray, "P H1 K 3"]  # m, the passive ones first; the first state is the true one
    score: Float[np.ndarray, "P H1"]  # of the step that led here; NaN at the start
    accepted: Bool[np.ndarray, "P H1"]


def predict(
    data: Path,
    /,
    *,
    dynamics: Path,
    out: Path,
    classifier: str | None = None,
    deviation: Path | None = None,
    split: str = "test",
    trajectories: int = 16,
    every: int = 5,
    horizon: int = 10,
) -> None:
    """Predict along recorded trajectories, judge each step, and record both beside what happened.

    Args:
        data: the data set, of any task and phase.
        dynamics: the run or model.eqx that predicts: dynamics or full dynamics.
        out: the record to write, ending in .npz, for doojax view.
        classifier: the run or model.eqx that says which steps hold; or collision_checker or always, which
            learn nothing.
        deviation: in place of it, an estimator of the error's run or model.eqx.
        split: train, validation, calibration or test.
        trajectories: how many of the split, from its first on.
        every: predictions begin at every so many states of a trajectory.
        horizon: steps that a prediction goes on for, at most.

    Raises:
        FileExistsError: there is a record of this name.
        ValueError: for models or data of different tasks, models of another kind, or numbers below 1.
    """
    command = command_line(predict, locals())
    for name, value in (("trajectories", trajectories), ("every", every), ("horizon", horizon)):
        if value < 1:
            raise ValueError(f"{name} is {value}, expected at least 1")
    if out.suffix != ".npz":
        raise ValueError(f"a record ends in .npz, got {out}")
    if out.exists():
        raise FileExistsError(f"{out} is there already: name another record by --out, or delete it")
    if classifier is not None and deviation is not None:
        raise ValueError("one judge at a time: give --classifier or --deviation, not both")
    dataset = open_dataset(data)
    task = task_of(dataset.config)
    predicts, header = load_model(dynamics, task=task.name)
    if header.kind not in DYNAMICS:
        raise ValueError(f"{dynamics} is a model of kind {header.kind!r}, expected {' or '.join(DYNAMICS)}")
    judge, judged_by = judge_of(classifier, deviation, task.name)
    chosen = load_split(dataset, split)
    chosen = jax.tree.map(lambda leaf: leaf[:trajectories], chosen)
    about = {
        "command": command,
        "split": split,
        "inputs": digests({"data": data, "dynamics": dynamics, **judge_file(classifier, deviation)}),
    }
    threshold = judged_by.about.get("threshold_m", header.about.get("threshold_m"))
    record = recorded(
        predicts, judge if judged_by.kind != "none" else None, judged_by.kind, chosen, every, horizon
    )
    record = PredictionRecord(
        task=task.name,
        look=Look.of(task.scene),
        period=task.scene.control_period,
        error_threshold=threshold,
        rows=np.asarray(chosen.rows),
        about=about,
        **record,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    save_record(out, record)
    console = Console(markup=False, highlight=False, soft_wrap=True)
    console.print(said(record))
    console.print(f"to see it all: doojax view {out}")


def judge_of(classifier: str | None, deviation: Path | None, task: str) -> tuple[Reliability, Header]:
    """The judge that a command names, and its header; of kind "none" where it names none.

    Raises:
        ValueError: for a model of another kind or task.
    """
    if deviation is not None:
        return load_model(deviation, task=task, kind="deviation")
    if classifier is None:
        return UNLEARNED["always"](), Header("none", task, {})
    if classifier in UNLEARNED:
        return UNLEARNED[classifier](), Header(classifier, task, {})
    judge, header = load_model(Path(classifier), task=task)
    if header.kind not in JUDGES:
        raise ValueError(f"{classifier} is a model of kind {header.kind!r}, expected {' or '.join(JUDGES)}")
    return judge, header


def judge_file(classifier: str | None, deviation: Path | None) -> dict[str, Path | None]:
    """The file of the judge, if it has one, by its name among a record's inputs."""
    learned = None if classifier is None or classifier in UNLEARNED else Path(classifier)
    return {"classifier": learned, "deviation": deviation}


def recorded(
    dynamics: Dynamics,
    judge: Reliability | None,
    kind: str,
    data: Trajectories,
    every: int,
    horizon: int,
) -> dict[str, Any]:
    """The fields of a `PredictionRecord` that come from data and models.

    Args:
        dynamics: predict.
        judge: of every step; None for none.
        kind: of the judge, such as "classifier".
        data: K trajectories of T actions.
        every: states between two predictions' starts.
        horizon: steps, at most.
    """
    count, length = data.actions.shape[:2]
    horizon = min(horizon, length)
    times = np.arange(0, length, every)
    number, time = (grid.ravel() for grid in np.meshgrid(np.arange(count), times, indexing="ij"))
    found = predictions(dynamics, judge, data, number, time, horizon)
    passive = data.states.passive
    true = np.asarray(data.states.bodies()).reshape(count * (length + 1), -1, 3)
    fields = {
        "obstacles": data.obstacles,
        "points": true[:, :passive],
        "grippers": true[:, passive:],
        "begins": np.arange(count) * (length + 1),
        "start": number * (length + 1) + time,
        "predicted_points": found.bodies[:, :, :passive],
        "predicted_grippers": found.bodies[:, :, passive:],
    }
    if judge is None:
        return fields
    name, bound = name_of_score(kind), threshold_of(judge)
    thresholds = {} if bound is None else {name: bound}
    return fields | {"scores": {name: found.score}, "thresholds": thresholds, "accepted": found.accepted}


def predictions(
    dynamics: Dynamics,
    judge: Reliability | None,
    data: Trajectories,
    number: Int[np.ndarray, "P"],
    time: Int[np.ndarray, "P"],
    horizon: int,
) -> Predictions:
    """Predict from states ``time`` of trajectories ``number`` on, each step from the last predicted state."""
    length = data.actions.shape[1]

    def one(row: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        which, first = row
        steps = jnp.minimum(first + jnp.arange(horizon), length - 1)
        state = jax.tree.map(lambda leaf: leaf[which, first], data.states)
        obstacles = jax.tree.map(lambda leaf: leaf[which], data.obstacles)
        states, uncertainty = roll_out(dynamics, obstacles, state, data.actions[which, steps])
        if judge is None:
            nothing = jnp.zeros(horizon)
            return states.bodies(), nothing, nothing > 0
        before, after = (jax.tree.map(lambda leaf, s=s: leaf[s], states) for s in (slice(-1), slice(1, None)))
        steps = Transition(before, data.actions[which, steps], after, uncertainty)
        found = jax.vmap(judge, in_axes=(None, 0))(obstacles, steps)
        return states.bodies(), found.score, found.accepted

    every = eqx.filter_jit(lambda rows: jax.lax.map(one, rows, batch_size=min(AT_ONCE, len(number))))
    bodies, score, accepted = map(np.array, every((jnp.asarray(number), jnp.asarray(time))))
    known = time[:, None] + np.arange(horizon + 1) <= length
    bodies[~known] = np.nan
    score = np.pad(score.astype(np.float64), ((0, 0), (1, 0)), constant_values=np.nan)
    score[~known] = np.nan
    return Predictions(bodies, score, np.pad(accepted, ((0, 0), (1, 0))) & known)


def said(record: PredictionRecord) -> str:
    """The errors and mistakes of a record in a few lines."""
    error = record.rms_errors()
    last = np.array([row[np.isfinite(row)][-1] for row in error])
    lines = [
        f"{len(error)} predictions along {len(record.begins)} trajectories: after up to {error.shape[1] - 1} "
        f"steps they are off by {100 * np.median(last):.1f} cm (median), at most {100 * last.max():.1f} cm"
    ]
    if record.error_threshold is not None and record.accepted is not None:
        counted, (accepts, rejects) = record.counted(), record.mistaken()
        lines.append(
            f"of {counted.sum():,} steps that begin right, {(counted & record.accepted).sum():,} were "
            f"accepted; {accepts.sum():,} of those were wrong (error above "
            f"{100 * record.error_threshold:.1f} cm), and {rejects.sum():,} right ones were rejected"
        )
    return "\n".join(lines)
