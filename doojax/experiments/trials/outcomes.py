"""How trials came out: the figures of an evaluation's records, by method."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from msgspec import Meta

from doojax.experiments.trials.executed import counts_of
from doojax.experiments.trials.methods import RECIPES
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.records import TrialRecord
from doojax.experiments.trials.volumes import volumes_of
from doojax.experiments.trials.why import why
from doojax.reading import checked, read_json, read_lines
from doojax.tasks import make_task

CONFIG, METHOD, SECONDS, SCENES = "config.json", "method.json", "seconds.jsonl", "all.scenes"
Count = Annotated[int, Meta(ge=0)]
COUNTS = ("searches", "extensions", "actions", "recovery_actions")


@dataclass(frozen=True)
class EvaluationConfig:
    """What every evaluation's config says."""

    task: str
    seed: int


@dataclass(frozen=True)
class Figures:
    """What a trial's record has to say about it."""

    final_error_m: Annotated[float, Meta(ge=0)]
    plan_s: Annotated[float, Meta(ge=0)]
    searches: Count
    extensions: Count
    actions: Count
    recovery_actions: Count


@dataclass(frozen=True)
class Seconds:
    """How long some trials took."""

    trials: Count
    seconds: Annotated[float, Meta(ge=0)]


@dataclass(frozen=True, eq=False)
class Outcomes:
    """One method's trials, in the order of their scenes."""

    method: str
    trials: Int[np.ndarray, "n"]  # numbers of the scenes
    success: Bool[np.ndarray, "n"]
    error: Float[np.ndarray, "n"]  # m, between the rope and the goal at the end
    plan_s: Float[np.ndarray, "n"]
    counts: dict[str, Int[np.ndarray, "n"]]  # see COUNTS
    judged: Int[np.ndarray, "n 2"]  # executed transitions of plans, and how many of them were wrong
    ends: tuple[str, ...]  # what ended each trial
    whys: tuple[str, ...]  # why it came out as it did
    minutes: float  # that the evaluation took, all told
    goal_radius: float  # m
    volumes: Float[np.ndarray, "n 2"] | None = None  # of containers: poured and spilled in the end

    def only(self, trials: Int[np.ndarray, "k"]) -> "Outcomes":
        """Those of some scenes."""
        kept = np.isin(self.trials, trials)
        chosen = np.flatnonzero(kept)
        return replace(
            self,
            trials=self.trials[kept],
            success=self.success[kept],
            error=self.error[kept],
            plan_s=self.plan_s[kept],
            counts={name: values[kept] for name, values in self.counts.items()},
            judged=self.judged[kept],
            ends=tuple(self.ends[i] for i in chosen),
            whys=tuple(self.whys[i] for i in chosen),
            volumes=None if self.volumes is None else self.volumes[kept],
        )


def read_evaluation(folder: Path) -> tuple[dict[str, Any], list[Outcomes]]:
    """The config of an evaluation and the outcomes of its methods, on the scenes that all of them have done.

    Raises:
        FileNotFoundError: there is no evaluation in the folder.
        ValueError: no method has a trial, or they have none in common.
    """
    file = folder / CONFIG
    if not file.exists():
        raise FileNotFoundError(f"{folder} holds no evaluation: doojax evaluate writes one")
    config = read_json(file, dict[str, Any], "the config of an evaluation")
    about = checked({name: config.get(name) for name in ("task", "seed")}, EvaluationConfig, str(file))
    make_task(about.task)  # raises for a name that is none
    names = sorted(file.parent.name for file in folder.glob(f"*/{METHOD}"))
    known = list(RECIPES)
    names.sort(key=lambda name: known.index(name) if name in known else len(known))
    found = [read_outcomes(folder / name) for name in names]
    found = [one for one in found if len(one.trials)]
    if not found:
        raise ValueError(f"{folder} holds no finished trial yet")
    common = set.intersection(*(set(one.trials.tolist()) for one in found))
    if not common:
        raise ValueError(f"the methods in {folder} have no scene in common: evaluate them further")
    return config, [one.only(np.array(sorted(common))) for one in found]


def read_outcomes(folder: Path) -> Outcomes:
    """What the records of one method say."""
    files = [path for path in sorted(folder.glob("*.npz")) if path.stem.isdecimal()]
    trials = [record for record in map(load_record, files) if isinstance(record, TrialRecord)]
    if len(trials) < len(files):
        raise ValueError(f"{folder} holds records that are no trials: delete them")
    figures = [_figures(path, record) for path, record in zip(files, trials, strict=True)]
    pours = bool(trials) and trials[0].look.what == "container"
    seconds = read_lines(folder / SECONDS, Seconds, "the seconds that trials took")
    return Outcomes(
        method=folder.name,
        trials=np.array([int(path.stem) for path in files], dtype=int),
        success=np.array([record.reached for record in trials], dtype=bool),
        error=np.array([one.final_error_m for one in figures], dtype=float),
        plan_s=np.array([one.plan_s for one in figures], dtype=float),
        counts={name: np.array([getattr(one, name) for one in figures], dtype=int) for name in COUNTS},
        judged=counts_of(trials),
        ends=tuple(record.end for record in trials),
        whys=tuple(map(why, trials)),
        minutes=sum(one.seconds for one in seconds) / 60,
        goal_radius=trials[0].goal_radius if trials else 0.0,
        volumes=np.array([volumes_of(record)[-1] for record in trials]) if pours else None,
    )


def _figures(path: Path, record: TrialRecord) -> Figures:
    try:
        return checked({field.name: record.about.get(field.name) for field in fields(Figures)}, Figures)
    except ValueError as error:
        raise ValueError(f"{path} does not say how its trial went: {error}") from error
