"""The colours of everything shown: one meaning each, told apart by the colour-blind too (Okabe and Ito)."""

import zlib

import numpy as np
from jaxtyping import Float, UInt8

from doojax.experiments.drawing import Colour
from doojax.experiments.trials.touching import is_table

ROPE: Colour = (213, 94, 0)
GRIPPER: Colour = (12, 12, 16)
OBSTACLE: Colour = (139, 152, 173)
TABLE: Colour = (196, 178, 152)  # what is far wider than high: something to put things on
GOAL: Colour = (0, 158, 115)
PREDICTION: Colour = (120, 81, 169)
CHOSEN: Colour = (0, 114, 178)
EXECUTED: Colour = (213, 94, 0)
REJECTED: Colour = (204, 121, 167)
RECOVERY: Colour = (240, 200, 0)
INSIDE: Colour = (20, 60, 150)  # an obstacle, in what a model saw
FLOOR: Colour = (244, 245, 247)
INK: Colour = (33, 37, 41)
PALE_INK: Colour = (110, 118, 128)
AXES: tuple[Colour, Colour, Colour] = ((214, 40, 40), (40, 150, 60), (40, 80, 200))  # x, y, z
OVERLAY: tuple[Colour, ...] = (
    ROPE,
    (0, 114, 178),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (160, 120, 0),
    (90, 60, 160),
    (120, 120, 120),
    (230, 159, 0),
)

# A method has its colour wherever it is shown; others than these take theirs from `OVERLAY`.
METHODS: dict[str, Colour] = {
    "classifier": (0, 114, 178),
    "no_classifier": (213, 94, 0),
    "collision_checker": (230, 159, 0),
    "oracle": (70, 70, 70),
    "full_dynamics": (86, 180, 233),
    "learned_recovery": (204, 121, 167),
    "random_recovery": (150, 110, 0),
    "deviation": (0, 140, 100),
    "voxel_classifier": (90, 60, 160),
}


def method_colour(method: str) -> Colour:
    """The colour of a method, the same everywhere."""
    return METHODS.get(method) or OVERLAY[zlib.crc32(method.encode()) % len(OVERLAY)]


_VIRIDIS = [(68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141)]
_VIRIDIS += [(39, 173, 129), (92, 200, 99), (170, 220, 50), (253, 231, 37)]
_TIME = [(254, 217, 118), (253, 174, 82), (244, 122, 40), (213, 77, 10), (138, 32, 12)]
_ERROR = [(30, 90, 200), (60, 180, 160), (240, 210, 40), (240, 120, 20), (200, 10, 30)]
_FADING = [(170, 80, 20), (225, 165, 110), (244, 240, 235)]
SCALES = {"viridis": _VIRIDIS, "time": _TIME, "error": _ERROR, "fading": _FADING}


def scale(name: str, values: Float[np.ndarray, "*k"]) -> UInt8[np.ndarray, "*k 3"]:
    """Colours of ``values`` between 0 and 1, clipped; grey where a value is missing.

    Args:
        name: viridis; time (pale to dark); error (blue to red); fading (brown to the floor's colour).
        values: any shape.
    """
    anchors = np.array(SCALES[name], dtype=float)
    where = np.clip(np.nan_to_num(values), 0, 1) * (len(anchors) - 1)
    channels = [np.interp(where, np.arange(len(anchors)), anchors[:, channel]) for channel in range(3)]
    found = np.stack(channels, axis=-1).round().astype(np.uint8)
    return np.where(np.isfinite(values)[..., None], found, np.uint8(150))


def to_unit(
    values: Float[np.ndarray, "*k"], low: float | None = None, high: float | None = None
) -> Float[np.ndarray, "*k"]:
    """``values`` stretched so that ``low`` becomes 0 and ``high`` 1; by default their own bounds."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.full(values.shape, np.nan)
    low = float(finite.min()) if low is None else low
    high = float(finite.max()) if high is None else high
    return (values - low) / (high - low if high > low else 1.0)


def obstacle_colour(half_size: Float[np.ndarray, "3"]) -> Colour:
    """Table tops are told from what stands on them by their size: 0.5 m and more, and flat."""
    return TABLE if is_table(half_size) else OBSTACLE
