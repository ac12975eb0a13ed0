"""How good trained models are on data that they have not seen: `doojax evaluate-model`."""

from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from doojax.commands import command_line
from doojax.datasets.progress import announce
from doojax.experiments.reports.provenance import digests
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import bootstrap
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.experiments.training.deviation import deviation_figures, deviation_rows
from doojax.experiments.training.pictures import draw_classifier, draw_deviation, draw_dynamics
from doojax.experiments.trials.judges import UNLEARNED as UNLEARNED
from doojax.experiments.trials.recovery import recovery_rows
from doojax.keys import check_seed, generator
from doojax.learning.checkpoints import Header, load_model
from doojax.learning.data import Trajectories, load_split, open_dataset
from doojax.learning.deviation import DeviationConfig, deviation_examples, deviations
from doojax.learning.labels import Examples, LabelConfig, label
from doojax.learning.metrics import Counts, auroc, counts, expected_calibration_error
from doojax.learning.reliability import judged_kept, require_both_classes
from doojax.learning.train import ALPHAS
from doojax.models.rolling import roll_out
from doojax.types import Obstacles, RopeState

RESAMPLES = 1000
MEASURED = Path("measured")  # where pictures go that are not published


def evaluate_model(
    model: str,
    /,
    *,
    data: Path,
    dynamics: Path | None = None,
    classifier: Path | None = None,
    seed: int = 0,
    json: bool = False,
    out: Path | None = None,
    publish: Path | None = None,
) -> None:
    """Measure a model on the test split of a data set, which chose nothing, and draw what was found.

    Args:
        model: a run or model.eqx; or always or collision_checker, which learn nothing.
        data: the data set; for dynamics any phase, for what judges predictions phase constrained.
        dynamics: the run or model.eqx whose predictions are judged; for all but dynamics.
        classifier: the run or model.eqx that says what is stuck; for a recovery network.
        seed: of what is random: intervals, and the actions of recoveries.
        json: print the rows as JSON instead of a table.
        out: the folder of the pictures; by default that of `publish`, or `measured`.
        publish: the folder of results whose summary.json gets the figures, such as results/where_to_trust;
            by default they are only shown.

    Raises:
        ValueError: for models or data of different tasks, or a test split with one class only.
    """
    check_seed(seed)
    command = command_line(evaluate_model, locals())
    out = out or publish or MEASURED
    dataset = open_dataset(data)
    task, phase = dataset.config["task"], dataset.config["phase"]
    if model in UNLEARNED:
        loaded, header = UNLEARNED[model](), Header(model, task, {})
    else:
        loaded, header = load_model(Path(model), task=task)
    tags = {"task": task, "model": header.kind, "preset": header.about.get("preset", "none")}
    test = load_split(dataset, "test")
    announce(f"measuring {model} on the test split of {data}")
    if header.kind in ("dynamics", "full_dynamics"):
        picture = out / f"{task}_{header.kind}_{phase}.png"
        rows = dynamics_rows(loaded, test, tags | {"phase": phase, "split": "test"}, picture)
        if "threshold_m" in header.about:
            rows.append(row("delta_m", tags, header.about["threshold_m"], "m"))
    elif dynamics is None:
        raise ValueError(f"a {header.kind} judges predictions: name the dynamics' run by --dynamics")
    elif header.kind == "recovery":
        if classifier is None:
            raise ValueError("what is stuck, the classifier says: name its run by --classifier")
        predicts, judges = (load_model(path, task=task)[0] for path in (dynamics, classifier))
        rows = recovery_rows(dataset, test, predicts, judges, loaded, tags, seed)
    elif header.kind == "deviation":
        predicts, _ = load_model(dynamics, task=task, kind="dynamics")
        rows = _deviation_rows(loaded, header, predicts, test, tags, out / f"{task}_deviation.png")
    else:
        ensemble, about = load_model(dynamics, task=task, kind="dynamics")
        threshold = header.about.get("threshold_m", about.about["threshold_m"])
        labels = LabelConfig(**header.about.get("labels", {}))
        examples = label(ensemble, test, labels)
        require_both_classes(examples, threshold, "test")
        safe = header.about.get("conformal_thresholds", {})
        picture = out / f"{task}_{header.kind}.png"
        rows = classifier_rows(loaded, examples, test.obstacles, threshold, safe, tags, seed, picture)
    learned = None if model in UNLEARNED else Path(model)
    inputs = digests({"model": learned, "data": data, "dynamics": dynamics, "classifier": classifier})
    publish_rows(publish, command=command, seed=seed, rows=rows, inputs=inputs)
    show(rows, json)


def dynamics_rows(model: Any, data: Trajectories, tags: dict[str, Any], picture: Path) -> list[Row]:
    """Distances between predicted and true points, m: overall, by step and by point."""
    error = prediction_errors(model, data)
    mean = bootstrap(error.mean((1, 2)))
    draw_dynamics(picture, error, f"{tags['task']}, {tags['model']}, {tags['phase']}")
    rows = [
        row("dynamics_error_m", tags, mean.value, "m", mean.low, mean.high, len(error)),
        row("dynamics_error_max_m", tags, error.max(), "m", n=error.size),
    ]
    for percent in (90, 95, 99):
        value = np.quantile(error, percent / 100)
        rows.append(row(f"dynamics_error_p{percent}_m", tags, value, "m", n=error.size))
    for step, value in enumerate(error.mean((0, 2)), start=1):
        rows.append(row("dynamics_error_at_step_m", tags | {"step": step}, value, "m", n=len(error)))
    for point, value in enumerate(error.mean((0, 1))):
        rows.append(row("dynamics_error_at_point_m", tags | {"point": point}, value, "m", n=len(error)))
    return rows


def prediction_errors(model: Any, data: Trajectories) -> Float[np.ndarray, "K T N"]:
    """Distance (m) of each predicted point from the true one when predicting from the first state."""

    def one(states: RopeState, actions: Array, obstacles: Obstacles) -> Array:
        first = jax.tree.map(lambda leaf: leaf[0], states)
        predicted, _ = roll_out(model, obstacles, first, actions)
        return jnp.linalg.norm((predicted.points - states.points)[1:], axis=-1)

    every = eqx.filter_jit(
        lambda: jax.lax.map(lambda x: one(*x), (data.states, data.actions, data.obstacles), batch_size=64)
    )
    return np.asarray(every())


def _deviation_rows(
    model: Any, header: Header, dynamics: Any, test: Trajectories, tags: dict[str, Any], picture: Path
) -> list[Row]:
    """Errors of predicted deviations and what their bounds keep, on what a plan could go on from."""
    limit = float(model.limit)
    horizon = header.about.get("horizon", DeviationConfig.horizon)
    examples = deviation_examples(dynamics, test, horizon=horizon, kept_below=limit)
    predicted, true = deviations(model, examples), np.asarray(examples.deviation)
    factors = {float(alpha): factor for alpha, factor in header.about.get("conformal_factors", {}).items()}
    figures = deviation_figures(predicted, true, np.asarray(examples.trajectory), factors)
    draw_deviation(picture, predicted, true, limit, f"{tags['task']}, deviation")
    return [*deviation_rows(figures, tags), row("limit_m", tags, limit, "m")]


def classifier_rows(
    judge: Any,
    examples: Examples,
    obstacles: Obstacles,
    threshold: float,
    safe: Mapping[str, float],
    tags: dict[str, Any],
    seed: int,
    picture: Path,
) -> list[Row]:
    """Counts, ranking, calibration and the conformal promise, on the test split.

    Args:
        judge: a `Reliability`.
        examples: predicted transitions of the split.
        obstacles: [K], of its trajectories.
        threshold: of the model error, m.
        safe: the score above which a transition is accepted, by the rate of wrong ones that is promised; as
            they were chosen on the calibration split.
        tags: of all rows.
        seed: of the intervals, for which whole trajectories are drawn anew: only they are independent.
        picture: where to draw how far probabilities are from frequencies.
    """
    judgements, right = judged_kept(judge, examples, obstacles, threshold)
    scores, accepted = judgements.score.astype(np.float64), judgements.accepted
    trajectory = np.asarray(examples.trajectory)[np.asarray(examples.kept(threshold))]
    n = len(right)
    found, drawn = counts(accepted, right), resampled(trajectory, accepted, right, seed)
    rows = [row("right_fraction", tags, right.mean(), "", n=n)]
    for name in ("accuracy", "precision", "recall", "specificity"):
        interval = _interval(getattr(drawn, name))
        rows.append(row(f"classifier_{name}", tags, getattr(found, name), "", *interval, n))
    rows.append(row("classifier_auroc", tags, auroc(scores, right), "", n=n))
    if tags["model"] in UNLEARNED:
        return rows
    rows.append(row("classifier_ece", tags, expected_calibration_error(scores, right), "", n=n))
    draw_classifier(picture, scores, right, f"{tags['task']}, {tags['model']}")
    for alpha in ALPHAS:
        rows += promise_rows(scores > safe.get(str(alpha), np.inf), right, trajectory, tags, alpha, seed)
    return rows


def promise_rows(
    accepted: Bool[np.ndarray, "n"],
    right: Bool[np.ndarray, "n"],
    trajectory: Int[np.ndarray, "n"],
    tags: dict[str, Any],
    alpha: float,
    seed: int,
) -> list[Row]:
    """How many are accepted, and which fraction of those is wrong, where at most ``alpha`` was promised.

    One threshold, chosen on other scenes, is tried once; the intervals come from the trajectories. There is
    no rate where nothing is accepted.
    """
    named, scenes = tags | {"alpha": alpha}, len(np.unique(trajectory))
    drawn = resampled(trajectory, accepted, right, seed)
    share = (drawn.accepted_right + drawn.accepted_wrong) / sum(astuple(drawn))
    rows = [
        row("conformal_accepted_fraction", named, accepted.mean(), "", *_interval(share), scenes),
    ]
    if accepted.any():
        wrong = 1 - counts(accepted, right).precision
        interval = _interval(1 - np.asarray(drawn.precision))
        rows.insert(0, row("conformal_violation", named, wrong, "", *interval, scenes))
    return rows


def resampled(
    trajectory: Int[np.ndarray, "n"],
    accepted: Bool[np.ndarray, "n"],
    right: Bool[np.ndarray, "n"],
    seed: int,
) -> Counts:
    """The counts of 1,000 samples, trajectories drawn anew with replacement."""
    kinds = np.stack([accepted & right, accepted & ~right, ~accepted & right, ~accepted & ~right], axis=1)
    numbers, index = np.unique(trajectory, return_inverse=True)
    totals = np.zeros((len(numbers), 4))
    np.add.at(totals, index, kinds)
    rng = generator(seed, "evaluate-model", "bootstrap")
    weights = rng.multinomial(len(numbers), np.full(len(numbers), 1 / len(numbers)), size=RESAMPLES)
    return Counts(*(weights @ totals).T)


def _interval(samples: float | Float[np.ndarray, "r"]) -> tuple[float | None, float | None]:
    """The middle 95 % of them; none where one of them is no number."""
    if np.isnan(samples).any():
        return None, None
    low, high = np.quantile(samples, [0.025, 0.975])
    return float(low), float(high)
