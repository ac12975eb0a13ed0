"""The methods of chapters II and IV by name: which dynamics, judged by what, recovering how."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from doojax.experiments.trials.carried import arms_of
from doojax.experiments.trials.recipes import RECIPES as RECIPES
from doojax.experiments.trials.setting import Method
from doojax.learning.checkpoints import Header
from doojax.models import Always, CollisionChecker, Conjunction, Stricter
from doojax.planning import simulated, simulated_start
from doojax.planning.recovery import RandomRecovery
from doojax.simulation.state import Simulator
from doojax.tasks.base import Task

PRETRAINED = Path(__file__).parents[1] / "pretrained"


def find_models(folder: Path | None, task: str) -> dict[str, Path]:
    """The files of models in a folder and the folders in it, by kind; further down, by FOLDER/kind.

    Raises:
        FileNotFoundError: there is no such folder.
        ValueError: two models are of one kind, or one is of another task.
    """
    if folder is None:
        return {}
    from doojax.learning.checkpoints import read_header

    found: dict[str, Path] = {}
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder of models {folder}")
    near = sorted([*folder.glob("*.eqx"), *folder.glob("*/model.eqx")])
    for path in [*near, *sorted(folder.glob("*/*/model.eqx"))]:
        header, _ = read_header(path)
        if header.task != task:
            raise ValueError(f"{path} was trained for the task {header.task!r}, not for {task!r}")
        name = header.kind if path in near else f"{path.parents[1].name}/{header.kind}"
        if name in found:
            raise ValueError(f"{found[name]} and {path} are both of kind {header.kind!r}: keep one")
        found[name] = path
    return found


def pretrained_models(task: str) -> dict[str, Path]:
    """The models that come with doojax, by kind; none for some tasks."""
    folder = PRETRAINED / task
    return find_models(folder, task) if folder.is_dir() else {}


def needed_models(name: str, models: Mapping[str, Path]) -> dict[str, Path]:
    """The models that a method needs, by kind, of those that there are.

    Without any, the dynamics are the simulator's own without obstacles: unconstrained, and exact.

    Raises:
        ValueError: for an unknown method, or one whose models are missing.
    """
    if name not in RECIPES:
        raise ValueError(f"unknown method {name!r}, expected one of {', '.join(RECIPES)}")
    names = dict(RECIPES[name].names)
    if not models and RECIPES[name].folder is None:
        names.pop("dynamics", None)
    missing = [one for one in names.values() if one not in models]
    if missing:
        there = ", ".join(models) or "none"
        raise ValueError(
            f"method {name!r} needs models of kind {', '.join(missing)}; there are: {there}. Train them with "
            "doojax train, and name their folder by --models"
        )
    return {kind: models[one] for kind, one in names.items()}


def make_method(
    name: str,
    task: Task,
    simulator: Simulator,
    models: Mapping[str, Path],
    accept: str | None = None,
    margin: float | None = None,
    arms: bool = False,
) -> Method:
    """The method called ``name``.

    Args:
        name: one of `RECIPES`.
        task: what is to be done.
        simulator: the dynamics of methods without learned ones.
        models: files by kind.
        accept: what a classifier must say for a transition to be accepted: "conformal:ALPHA", above the
            threshold at which at most the fraction ALPHA of accepted transitions was to be wrong; by default
            more likely right than wrong. Of a deviation it is the upper bound that is to be exceeded by the
            fraction ALPHA, by default the expected one, that must be below its limit. Methods with neither
            do not look at it.
        margin: metres, what the collision checker keeps from obstacles; by default its own. Other methods do
            not look at it.
        arms: whether the task's arms must be able to carry the hands, see
            `doojax.experiments.trials.carried`.

    Raises:
        ValueError: as `needed_models`, for a rate for which the classifier has no threshold, for a margin
            that is negative or not finite, and for arms that the task lacks, or of a policy.
    """
    carried = arms_of(task) if arms else None
    if margin is not None and not 0 <= margin < float("inf"):
        raise ValueError(f"margin is {margin}, expected metres, at least 0")
    from doojax.learning.checkpoints import load_model

    needed, recipe = needed_models(name, models), RECIPES[name]
    errors: dict[str, Any] = {}

    def loaded(kind: str) -> Any:
        model, header = load_model(needed[kind], task=task.name, kind=kind)
        errors[kind] = header.about.get("threshold_m")
        if accept is not None and kind == "deviation":
            return model.bounded(conformal_value(accept, header, needed[kind]))
        if accept is not None and kind == recipe.reliability:
            return Stricter(model, conformal_value(accept, header, needed[kind]))
        return model

    made: dict[str, Any] = {"begin": simulated_start} if recipe.dynamics == "simulator" else {}
    if recipe.dynamics in needed:
        dynamics = loaded(recipe.dynamics)
    else:
        dynamics = simulated(simulator)
        made.setdefault("begin", partial(simulated_start, without_obstacles=True))
    checker = CollisionChecker if margin is None else partial(CollisionChecker, margin)
    unlearned = {"always": Always, "collision_checker": checker, "random": RandomRecovery}

    def judge(kind: str) -> Any:
        return unlearned[kind]() if kind in unlearned else loaded(kind)

    recovery = judge(recipe.recovery) if recipe.recovery else None
    if recipe.policy and carried is not None:
        raise ValueError(f"method {name!r} plans nothing that could be kept to what arms carry: no --arms")
    if recipe.policy:
        made["policy"] = loaded(recipe.policy)
    judging = judge(recipe.reliability)
    if carried is not None:
        judging = Conjunction((judging, carried))
        made["arms"] = carried
    made["error_threshold_m"] = errors.get(recipe.reliability) or errors.get(recipe.dynamics)
    return Method(name, dynamics, judging, recovery, **made)


def conformal_value(accept: str, header: Header, path: Path) -> float:
    """What a model's header has for "conformal:ALPHA": a classifier's threshold, a deviation's factor.

    Raises:
        ValueError: for another text, or a rate for which there is none; the message lists those there are.
    """
    name = "conformal_factors" if header.kind == "deviation" else "conformal_thresholds"
    safe = header.about.get(name, {})
    kind, _, alpha = accept.partition(":")
    there = ", ".join(f"conformal:{rate}" for rate in safe) or "none"
    if kind != "conformal" or alpha not in safe:
        raise ValueError(f"accept is {accept!r}, expected one of those that {path} has: {there}")
    return float(safe[alpha])
