"""How good trained models are on data that they have not seen: `doojax evaluate-model`."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.commands import command_line
from doojax.experiments.model_pictures import draw_classifier, draw_dynamics
from doojax.experiments.provenance import digests
from doojax.experiments.recovery_trials import recovery_rows
from doojax.experiments.reports import Row, publish_rows, row, show
from doojax.experiments.statistics import bootstrap
from doojax.keys import generator
from doojax.learning.calibration import conformal_threshold
from doojax.learning.checkpoints import Header, load_model
from doojax.learning.data import Trajectories, load_split, open_dataset
from doojax.learning.labels import Examples, LabelConfig, label
from doojax.learning.metrics import Counts, auroc, counts, expected_calibration_error
from doojax.learning.reliability import judged_kept, require_both_classes
from doojax.learning.train import ALPHAS
from doojax.models import Always, CollisionChecker
from doojax.types import Obstacles, RopeState

UNLEARNED = {"always": Always, "collision_checker": CollisionChecker}
RESPLITS = 20
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
    """Measure a model on the test split of a data set, and draw what was found.

    Args:
        model: a run or model.eqx; or always or collision_checker, which learn nothing.
        data: the data set; for dynamics any phase, for what judges predictions phase constrained.
        dynamics: the run or model.eqx whose predictions are judged; for all but dynamics.
        classifier: the run or model.eqx that says what is stuck; for a recovery network.
        seed: of what is random: splits, and the actions of recoveries.
        json: print the rows as JSON instead of a table.
        out: the folder of the pictures; by default that of `publish`, or `measured`.
        publish: the folder of results whose summary.json gets the figures, such as results/where_to_trust;
            by default they are only shown.

    Raises:
        ValueError: for models or data of different tasks, or a test split with one class only.
    """
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
    else:
        ensemble, about = load_model(dynamics, task=task, kind="dynamics")
        threshold = header.about.get("threshold_m", about.about["threshold_m"])
        labels = LabelConfig(**header.about.get("labels", {}))
        examples = label(ensemble, test, labels)
        require_both_classes(examples, threshold, "test")
        spare = load_split(dataset, "validation")
        more = label(ensemble, spare, labels)
        rows = classifier_rows(
            loaded,
            ((examples, test.obstacles), (more, spare.obstacles)),
            threshold,
            tags,
            seed,
            out / f"{task}_{header.kind}.png",
        )
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

        def step(state: RopeState, action: Array):
            after, _ = model(obstacles, state, action)
            return after, after.points

        _, points = jax.lax.scan(step, first, actions)
        return jnp.linalg.norm(points - states.points[1:], axis=-1)

    every = eqx.filter_jit(
        lambda: jax.lax.map(lambda x: one(*x), (data.states, data.actions, data.obstacles), batch_size=64)
    )
    return np.asarray(every())


def classifier_rows(
    judge: Any,
    parts: tuple[tuple[Examples, Obstacles], tuple[Examples, Obstacles]],
    threshold: float,
    tags: dict[str, Any],
    seed: int,
    picture: Path,
) -> list[Row]:
    """Counts, ranking, calibration and the conformal promise; ``parts`` are test and validation."""
    scores, right, trajectory = [], [], []
    for examples, obstacles in parts:
        values, correct = judged_kept(judge, examples, obstacles, threshold)
        scores.append(values.astype(np.float64))
        right.append(correct)
        trajectory.append(np.asarray(examples.trajectory)[np.asarray(examples.kept(threshold))])
    limit = float(judge.threshold)
    found, n = counts(scores[0] > limit, right[0]), len(right[0])
    rows = [row("right_fraction", tags, right[0].mean(), "", n=n)]
    drawn = _by_trajectory(trajectory[0], scores[0] > limit, right[0], seed)
    for name in ("accuracy", "precision", "recall", "specificity"):
        samples = np.asarray(getattr(drawn, name))
        low, high = (None, None) if np.isnan(samples).any() else np.quantile(samples, [0.025, 0.975])
        rows.append(row(f"classifier_{name}", tags, getattr(found, name), "", low, high, n))
    rows.append(row("classifier_auroc", tags, auroc(scores[0], right[0]), "", n=n))
    if tags["model"] in UNLEARNED:
        return rows
    rows.append(row("classifier_ece", tags, expected_calibration_error(scores[0], right[0]), "", n=n))
    all_scores, all_right = np.concatenate(scores), np.concatenate(right)
    numbers = np.concatenate([trajectory[0], trajectory[1] + trajectory[0].max() + 1])
    for alpha in ALPHAS:
        wrong, accepted = resplits(all_scores, all_right, numbers, alpha, seed)
        error = wrong.std(ddof=1) / RESPLITS**0.5
        named = tags | {"alpha": alpha}
        low, high = max(wrong.mean() - 2 * error, 0.0), wrong.mean() + 2 * error
        rows.append(row("conformal_violation", named, wrong.mean(), "", low, high, RESPLITS))
        rows.append(row("conformal_accepted_fraction", named, accepted.mean(), "", n=RESPLITS))
    draw_classifier(picture, scores[0], right[0], f"{tags['task']}, {tags['model']}")
    return rows


def resplits(
    scores: np.ndarray, right: np.ndarray, trajectory: np.ndarray, alpha: float, seed: int
) -> tuple[Float[np.ndarray, "r"], Float[np.ndarray, "r"]]:
    """Choose a conformal threshold on a random half of the trajectories and count on the other half.

    Returns:
        of each resplit the fraction of accepted transitions that are wrong, 0 where none is accepted, and
        the fraction that is accepted.
    """
    rng = generator(seed, "evaluate-model", "resplits")
    numbers = np.unique(trajectory)
    wrong, accepted = np.zeros(RESPLITS), np.zeros(RESPLITS)
    for i in range(RESPLITS):
        chosen = np.isin(trajectory, rng.permutation(numbers)[: len(numbers) // 2])
        limit = conformal_threshold(scores[chosen], right[chosen], alpha)
        passed = scores[~chosen] > limit
        accepted[i] = passed.mean()
        wrong[i] = (passed & ~right[~chosen]).sum() / max(passed.sum(), 1)
    return wrong, accepted


def _by_trajectory(trajectory: np.ndarray, accepted: np.ndarray, right: np.ndarray, seed: int) -> Counts:
    """The counts of 1,000 samples, trajectories drawn anew with replacement."""
    kinds = np.stack([accepted & right, accepted & ~right, ~accepted & right, ~accepted & ~right], axis=1)
    numbers, index = np.unique(trajectory, return_inverse=True)
    totals = np.zeros((len(numbers), 4))
    np.add.at(totals, index, kinds)
    rng = generator(seed, "evaluate-model", "bootstrap")
    drawn = rng.multinomial(len(numbers), np.full(len(numbers), 1 / len(numbers)), size=1000) @ totals
    return Counts(*drawn.T)
