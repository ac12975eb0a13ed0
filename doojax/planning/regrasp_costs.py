"""What a grasp costs: the terms of the thesis's equation 5.3, each a function of one candidate.

Where thesis and released code differ: the thesis's term for the goal signature is an indicator, the code's an
L1 distance of arrays that ignores the order of a multiset; here it is the metric of
`doojax.topology.signatures.distance`. The geodesic term is the sum over the grippers that hold the rope, as
the equation's inner product and the latest code have it; the code of the published figures had the least.
"""

from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from doojax.geometry.frames import safe_norm
from doojax.topology.signatures import Blocklist, Signature, distance


@dataclass(frozen=True)
class RegraspWeights:
    """Those of the released code."""

    infeasible: float = 1000.0
    blocklist: float = 100.0
    goal_signature: float = 100.0
    geodesic: float = 30.0
    robot: float = 0.01
    rope: float = 6.0
    most: float = 50.0  # that motion costs, of the robot or the rope
    geodesics: Literal["sum", "least"] = "sum"


WEIGHTS = RegraspWeights()


def infeasible(feasible: Bool[Array, ""], weights: RegraspWeights = WEIGHTS) -> Float[Array, ""]:
    """One large cost for what cannot be done."""
    return jnp.where(feasible, 0.0, weights.infeasible)


def blocklisted(
    signature: Signature, blocklist: Blocklist, weights: RegraspWeights = WEIGHTS
) -> Float[Array, ""]:
    """One cost for a signature on the blocklist."""
    return jnp.where(blocklist.contains(signature), weights.blocklist, 0.0)


def other_signature(
    signature: Signature, goal: Signature, weights: RegraspWeights = WEIGHTS
) -> Float[Array, ""]:
    """How far a signature is from the goal's; `ValueError` for one over another skeleton."""
    return weights.goal_signature * distance(signature, goal).astype(float)


def far_from_keypoint(
    places: Float[Array, "G"], keypoint: float | Float[Array, ""], weights: RegraspWeights = WEIGHTS
) -> Float[Array, ""]:
    """By distance along the rope from the keypoint of what grippers hold; NaN for one that holds nothing."""
    apart, held = jnp.abs(places - keypoint), ~jnp.isnan(places)
    total = jnp.where(held, apart, 0).sum()
    least = jnp.where(held, apart, jnp.inf).min()
    return weights.geodesic * (total if weights.geodesics == "sum" else least)


def robot_motion(waypoints: Float[Array, "W J"], weights: RegraspWeights = WEIGHTS) -> Float[Array, ""]:
    """By the squares of the steps between waypoints, rad^2, summed."""
    return jnp.minimum(weights.robot * ((waypoints[1:] - waypoints[:-1]) ** 2).sum(), weights.most)


def rope_motion(
    before: Float[Array, "N 3"], after: Float[Array, "N 3"], weights: RegraspWeights = WEIGHTS
) -> Float[Array, ""]:
    """By the mean distance (m) that the rope's points move."""
    return jnp.minimum(weights.rope * safe_norm(*(after - before).T).mean(), weights.most)
