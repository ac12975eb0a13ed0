"""How trials came out: the figures of an evaluation's records, by method."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from doojax.experiments.methods import RECIPES
from doojax.experiments.records import TrialRecord, load_record

CONFIG, METHOD, SECONDS, SCENES = "config.json", "method.json", "seconds.jsonl", "all.scenes"
COUNTS = ("searches", "extensions", "actions", "recovery_actions")


@dataclass(frozen=True, eq=False)
class Outcomes:
    """One method's trials, in the order of their scenes."""

    method: str
    trials: Int[np.ndarray, "n"]  # numbers of the scenes
    success: Bool[np.ndarray, "n"]
    error: Float[np.ndarray, "n"]  # m, between the rope and the goal at the end
    plan_s: Float[np.ndarray, "n"]
    counts: dict[str, Int[np.ndarray, "n"]]  # see COUNTS
    ends: tuple[str, ...]  # why each trial ended
    minutes: float  # that the evaluation took, all told
    goal_radius: float  # m

    def only(self, trials: Int[np.ndarray, "k"]) -> "Outcomes":
        """Those of some scenes."""
        kept = np.isin(self.trials, trials)
        return Outcomes(
            self.method,
            self.trials[kept],
            self.success[kept],
            self.error[kept],
            self.plan_s[kept],
            {name: values[kept] for name, values in self.counts.items()},
            tuple(end for end, keep in zip(self.ends, kept, strict=True) if keep),
            self.minutes,
            self.goal_radius,
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
    config = json.loads(file.read_text(encoding="utf-8"))
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
    files = sorted(path for path in folder.glob("*.npz") if not path.name.startswith("."))
    records = [load_record(path) for path in files]
    trials = [record for record in records if isinstance(record, TrialRecord)]

    def column(read: Callable[[TrialRecord], Any], kind: type) -> np.ndarray:
        return np.array([read(record) for record in trials], dtype=kind)

    seconds = [json.loads(line)["seconds"] for line in _lines(folder / SECONDS)]
    return Outcomes(
        method=folder.name,
        trials=np.array([int(path.stem) for path in files], dtype=int),
        success=column(lambda record: record.reached, bool),
        error=column(lambda record: record.about["final_error_m"], float),
        plan_s=column(lambda record: record.about["plan_s"], float),
        counts={name: column(lambda record, name=name: record.about[name], int) for name in COUNTS},
        ends=tuple(record.end for record in trials),
        minutes=sum(seconds) / 60,
        goal_radius=trials[0].goal_radius if trials else 0.0,
    )


def _lines(file: Path) -> list[str]:
    """Whole lines; a last one that was being written when the process was killed is left out."""
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    return text[: text.rfind("\n") + 1].splitlines()
