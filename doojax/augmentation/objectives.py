"""What makes an augmentation bad: the terms of the thesis's equation 3.2, each a pure function (3.3 to 3.7).

All are zero for the example itself, up to what their docstrings say, and never negative. They read exact
signed distances of points that carry a radius: d = (distance to the nearest obstacle) - radius.

Occupancy differs from the thesis's in one thing. There, a point that is inside an obstacle has to be inside
afterwards (3.5), however deep: a rope that lies on a table could be pressed into it. Here a point that
touches has to touch, no deeper than before. `Bands` say so for every point; with ``(-inf, 0)`` for what is
inside and ``(0, inf)`` for what is not, the term is the thesis's.
"""

from dataclasses import asdict, astuple, dataclass
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.geometry.shapes import FAR

ROUNDING = 2e-6  # m: of distances in float32, so that an example lies within its own bands


class Bands(eqx.Module):
    """Between which distances (m) each of Q points has to be."""

    low: Float[Array, "Q"]
    high: Float[Array, "Q"]

    @classmethod
    def of(cls, distance: Float[Array, "Q"], skin: float) -> "Bands":
        """What touched, d < ``skin`` (m), touches afterwards, no deeper; what did not, does not."""
        touches = distance < skin
        low = jnp.where(touches, jnp.minimum(distance, 0.0) - skin, skin - ROUNDING)
        return cls(low, jnp.where(touches, skin + ROUNDING, 10 * FAR))

    def narrowed(self, margin: float) -> "Bands":
        """Bands to aim at, within these by ``margin`` (m), so that what comes near them is within these."""
        return Bands(self.low + margin, self.high - margin)


@dataclass(frozen=True)
class Weights:
    """Of the terms, with the released code's values (for rope and pushing alike)."""

    box: float = 0.05
    validity: float = 1.0
    occupancy: float = 1.0
    distance: float = 0.1
    robot: float = 1.0

    def __post_init__(self):
        """Refuse what would seek out what is bad."""
        for name, weight in asdict(self).items():
            if not weight >= 0:
                raise ValueError(f"the weight {name} is {weight}, expected at least 0")


class Terms(NamedTuple):
    """The terms of one moved example."""

    box: Float[Array, ""]  # m, sum over points and axes
    validity: Float[Array, ""]
    occupancy: Float[Array, ""]  # m, sum over points
    distance: Float[Array, ""]  # m^2
    robot: Float[Array, ""]  # m^2

    def total(self, weights: Weights) -> Float[Array, ""]:
        """The weighted sum (3.8)."""
        return sum(
            (weight * term for weight, term in zip(astuple(weights), self, strict=True)),
            start=jnp.zeros_like(self.box),
        )


def box_excess(along: Float[Array, "Q"], low: Float[Array, ""], high: Float[Array, ""]) -> Float[Array, "Q"]:
    """How far (m) each point is outside the workspace along one axis; the sum of all is equation 3.3."""
    return jnp.maximum(along - high, 0.0) + jnp.maximum(low - along, 0.0)


def occupancy_excess(distance: Float[Array, "Q"], bands: Bands) -> Float[Array, "Q"]:
    """How far (m) each point's distance is from its band; the sum takes the place of equation 3.5."""
    return jnp.maximum(bands.low - distance, 0.0) + jnp.maximum(distance - bands.high, 0.0)


def distance_change(
    before: Float[Array, ""], after: Float[Array, ""], tolerance: float = 0.0
) -> Float[Array, ""]:
    """Equation 3.6, m^2: of the point that was nearest to an obstacle, by how much its distance changes.

    Changes up to ``tolerance`` (m) are free.
    """
    return jnp.maximum(jnp.abs(after - before) - tolerance, 0.0) ** 2


def robot_contact(robot: Float[Array, "C 3"], objects: Float[Array, "C 3"]) -> Float[Array, ""]:
    """Equation 3.7, m^2: squared gaps between C contact points of a robot and of what it touches."""
    return jnp.sum((robot - objects) ** 2)


def any_transform(parameters: Float[Array, "6"]) -> Float[Array, ""]:
    """Equation 3.4 where every transform is valid."""
    return jnp.zeros_like(parameters[0])


def free_hands(parameters: Float[Array, "6"]) -> Float[Array, ""]:
    """Equation 3.7 for hands without arms: they go with what they hold, whatever the transform."""
    return jnp.zeros_like(parameters[0])
