"""What a controller that samples tried at each command of a trial, in the arrays of the trial's record.

In `TrialRecord.replay`, for T commands, each made in the state of its number::

    tried              T K H 3   where the point that is to reach the goal came to, m, by the best K samples
    tried_cost         T K       what they cost, the cheapest first; NaN where one has no cost
    planned            T H 3     the same point by the controls that were chosen
    planned_joints     T H J     joints of arms by them
    planned_tool       T H 3     the tool that holds, m
    term_NAME          T         mean cost of the samples by a term, as they were weighted
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from doojax.experiments.trials.records import TrialRecord

KEPT = 24  # samples of a command
TERM = "term_"


@dataclass(frozen=True, eq=False)
class Tried:
    """T commands with K samples of H controls; the arrays of the module's text."""

    tried: Float[np.ndarray, "T K H 3"]
    tried_cost: Float[np.ndarray, "T K"]
    planned: Float[np.ndarray, "T H 3"]
    planned_joints: Float[np.ndarray, "T H J"]
    planned_tool: Float[np.ndarray, "T H 3"]
    terms: Mapping[str, Float[np.ndarray, "T"]]

    def packed(self) -> dict[str, np.ndarray]:
        """For a record: places as float16, which are known to half a millimetre, and costs as float32."""
        small = {
            name: np.asarray(values, np.float16) for name, values in vars(self).items() if name in PLACES
        }
        costs = {TERM + name: np.asarray(values, np.float32) for name, values in self.terms.items()}
        return small | {"tried_cost": np.asarray(self.tried_cost, np.float32)} | costs


PLACES = ("tried", "planned", "planned_joints", "planned_tool")


def tried_in(record: TrialRecord) -> Tried | None:
    """What a record holds of it; None where it holds nothing.

    Raises:
        ValueError: for arrays that do not fit together.
    """
    replay = record.replay
    if "tried" not in replay:
        return None
    names = ("tried_cost", *PLACES)
    terms = {name.removeprefix(TERM): replay[name] for name in replay if name.startswith(TERM)}
    missing = [name for name in names if name not in replay]
    if missing:
        raise ValueError(f"the record has what was tried, but no {', '.join(missing)}")
    shape = replay["tried"].shape
    commands, samples, horizon = shape[:3] if len(shape) == 4 else (-1, -1, -1)
    expected = {
        "tried": (commands, samples, horizon, 3),
        "tried_cost": (commands, samples),
        "planned": (commands, horizon, 3),
        "planned_joints": (commands, horizon, *replay["planned_joints"].shape[2:]),
        "planned_tool": (commands, horizon, 3),
        **{TERM + name: (commands,) for name in terms},
    }
    for name, wanted in expected.items():
        if replay[name].shape != wanted or replay[name].dtype.kind != "f":
            raise ValueError(
                f"{name} is {replay[name].dtype} {replay[name].shape}, expected floats {wanted}: axes of "
                "commands, samples, controls and coordinates"
            )
    if commands != len(record.points) - 1:
        raise ValueError(f"{commands} commands were tried for, expected {len(record.points) - 1}, one a step")
    return Tried(**{name: np.asarray(replay[name], np.float32) for name in names}, terms=terms)


def costs_by_term(record: TrialRecord) -> dict[str, Float[np.ndarray, "T1"]]:
    """What commands were expected to cost, by term, in the states they were made in; NaN elsewhere.

    Of trials that regrasp from what their record says of its steps.
    """
    states, found = len(record.points), {}
    tried = tried_in(record)
    if tried is not None:
        return {name: np.append(values, np.nan) for name, values in tried.terms.items()}
    for step in record.about.get("steps", ()):
        for name, value in step.items():
            if name.startswith("cost_") and 0 < step["step"] < states:
                curve = found.setdefault(name.removeprefix("cost_"), np.full(states, np.nan))
                curve[step["step"] - 1] = value
    return found
