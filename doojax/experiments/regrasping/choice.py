"""Which candidate is executed, and when a signature goes on the blocklist: what methods differ in."""

from collections.abc import Callable
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Float, Key

from doojax.planning.regrasp import SAME_PLACE, Candidates, geodesic, got_stuck
from doojax.topology.signatures import Blocklist, Signature

Method = Literal["signature", "no_signature", "always_blocklist", "nearest"]


@runtime_checkable
class Choices(Protocol):
    """Candidates and what they cost, such as `doojax.experiments.regrasping.planner.Plans`."""

    now: tuple[float, ...]  # places along the rope that hands hold; NaN for nothing
    candidates: Candidates
    signature_before: Signature

    def costs(self, blocklist: Blocklist) -> Float[np.ndarray, "C"]:
        """Of each candidate, with this blocklist."""
        ...

    def best(self, costs: Callable[[Any], Float[np.ndarray, "C"]]) -> int | None:
        """The feasible candidate with the least ``costs(choices)``."""
        ...


def choose(
    method: Method, choices: Choices, blocklist: Blocklist, keypoint: float, key: Key[jax.Array, ""]
) -> tuple[int | None, Blocklist]:
    """The candidate to execute, and the blocklist as it then is.

    - signature: algorithm 6. The signature is listed if no grasp nearer to the keypoint is found, and
      candidates are priced anew, as in the released code; the algorithm samples and simulates again.
    - always_blocklist: it is listed every time.
    - no_signature: it never is.
    - nearest: no costs, see `nearest_or_random`.
    """
    drawn = np.asarray(jax.random.uniform(key, (len(choices.candidates),)))
    if method == "nearest":
        values = nearest_or_random(choices.candidates.places, choices.now, keypoint, drawn)
        return choices.best(lambda _: values), blocklist
    holds = not np.isnan(choices.now).all()
    if method == "always_blocklist" and holds:
        blocklist = blocklist.add(choices.signature_before)
    best = choices.best(lambda one: one.costs(blocklist))
    if method != "signature" or best is None:
        return best, blocklist
    if not got_stuck(choices.now, choices.candidates.places[best].tolist(), keypoint):
        return best, blocklist
    listed = blocklist.add(choices.signature_before)
    return choices.best(lambda one: one.costs(listed)), listed


def nearest_or_random(
    places: Float[np.ndarray, "C G"],
    now: tuple[float, ...],
    keypoint: float,
    drawn: Float[np.ndarray, "C"],
) -> Float[np.ndarray, "C"]:
    """The simple baseline's costs: how far from the keypoint along the rope, if that is nearer than now;
    else what was drawn, 0 to 1, which comes after all these."""
    apart, before = geodesic(places, keypoint), geodesic(np.asarray(now), keypoint)
    return np.where(apart < before - SAME_PLACE, apart, 10 + drawn)


def listing(blocklist: Blocklist) -> list[str]:
    """The signatures on a blocklist, as text."""
    count = int(blocklist.length)
    return [str(jax.tree.map(lambda leaf, i=i: leaf[i], blocklist.entries)) for i in range(count)]
