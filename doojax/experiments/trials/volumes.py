"""How much of a container was poured and spilled in a trial, from the gauges that its record holds."""

import numpy as np
from jaxtyping import Float

from doojax.experiments.trials.records import TrialRecord
from doojax.tasks.watering import AT_LEAST
from doojax.types import SPILT, WHOLE


def volumes_of(record: TrialRecord) -> Float[np.ndarray, "T1 2"]:
    """What is poured and what is spilled, parts of the whole, in every state: see `PouringState`.

    Raises:
        ValueError: for a record of something else.
    """
    if record.look.what != "container":
        raise ValueError(f"a trial of {record.task} pours nothing, expected one of a container")
    height = record.points[:, 0, 2] - record.goal[2]
    nothing = np.asarray(record.about["more_targets"])[0, 2]
    return np.stack([AT_LEAST + height / WHOLE, (record.points[:, 1, 2] - nothing) / SPILT], axis=1)


def said_of(poured: float, spilled: float) -> str:
    """Both in words."""
    return f"{100 * poured:.0f} % poured, {100 * spilled:.0f} % spilled"
