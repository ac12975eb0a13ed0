"""What is left of coordinates when they become an array of JAX: by default they are rounded to float32.

Its numbers have seven digits. Near the origin that is plenty; of map coordinates, millions of metres from it,
half a metre is lost. Once lost, no subtraction brings it back: subtract in double precision, before.
"""

import jax.numpy as jnp
import numpy as np

ALLOWED = 1e-4
"""Of the extent of some coordinates: how far they may be rounded."""


class LostDigits(ValueError):
    """Coordinates are too far from the origin for their precision."""


def rounding(*arrays: np.ndarray, own: bool = False) -> float:
    """How far apart neighbouring coordinates lie at the largest of some, as JAX holds them; metres.

    Args:
        arrays: coordinates, metres.
        own: as the arrays themselves hold them instead; whole numbers hold all.
    """
    spacing = 0.0
    for array in map(np.asarray, arrays):
        kind = array.dtype if own else jnp.result_type(float)
        if array.size and np.issubdtype(kind, np.floating):
            spacing = max(spacing, float(np.finfo(kind).eps) * float(np.abs(array).max()))
    return spacing


def require_digits(name: str, advice: str, *arrays: np.ndarray, allowed: float | None = None) -> None:
    """Refuse coordinates that JAX would round too far.

    Args:
        name: what an error calls them.
        advice: what an error says is to be done.
        arrays: [*p, 3] coordinates, metres.
        allowed: metres; by default `ALLOWED` of the longest side of their bounding box.

    Raises:
        LostDigits: a ValueError with the name, how far they would be rounded, and the advice.
    """
    points = np.concatenate([np.reshape(array, (-1, 3)) for array in arrays]) if arrays else np.zeros((0, 3))
    if not len(points):
        return
    extent = float(np.ptp(points, axis=0).max())
    spacing = rounding(points)
    if spacing > (ALLOWED * extent if allowed is None else allowed):
        raise LostDigits(
            f"coordinates of {name} are up to {np.abs(points).max():.9g} m, which "
            f"{jnp.result_type(float)} rounds to {spacing:.1g} m; they are {extent:.3g} m across: {advice}"
        )
