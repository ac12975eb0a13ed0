"""Which candidate is executed, and when a signature goes on the blocklist: what methods differ in."""

from collections.abc import Callable
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Bool, Float, Key

from doojax.planning.regrasp import SAME_PLACE, Candidates, geodesic, got_stuck
from doojax.topology.signatures import Blocklist, Signature

Method = Literal["signature", "no_signature", "always_blocklist", "nearest", "tamp5", "tamp50", "wang"]
REACHING: tuple[Method, ...] = (
    "signature",
    "always_blocklist",
    "no_signature",
    "tamp5",
    "tamp50",
    "nearest",
)  # that bring a point to a place: algorithm 6
THREADING: tuple[Method, ...] = ("signature", "no_signature", "tamp5", "tamp50", "wang", "nearest")
STEPS_AHEAD: dict[Method, int] = {
    "tamp5": 5,
    "tamp50": 50,
}  # of control that are simulated for each candidate
NEAR_FIXTURE = 0.08  # m, of a hand from a fixture's centre: there "wang" looks whether it is stuck


@runtime_checkable
class Choices(Protocol):
    """Candidates and what they cost, such as `doojax.experiments.regrasping.planner.Plans`."""

    now: tuple[float, ...]  # places along the rope that hands hold; NaN for nothing
    candidates: Candidates
    signature_before: Signature

    def costs(self, blocklist: Blocklist) -> Float[np.ndarray, "C"]:
        """Of each candidate, with this blocklist."""
        ...

    def fits(self) -> Bool[np.ndarray, "C"]:
        """Which candidates lead to the signature that is wanted."""
        ...

    def foreseen(self) -> Float[np.ndarray, "C"]:
        """What control comes to after each candidate, priced."""
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
    - tamp5, tamp50: it never is. What so many steps of control come to after each candidate counts beside
      the terms that look at no signature.
    - nearest: no costs, see `nearest_or_random`.

    Raises:
        ValueError: for a method that is none of algorithm 6.
    """
    if method not in REACHING:
        raise ValueError(f"method is {method!r}, expected one of {', '.join(REACHING)}: wang only threads")
    if method == "nearest":
        values = nearest_of(choices, keypoint, key)
        return choices.best(lambda _: values), blocklist
    if method in STEPS_AHEAD:
        ahead = choices.foreseen()
        return choices.best(lambda one: one.costs(blocklist) + ahead), blocklist
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


def choose_threading(
    method: Method,
    choices: Choices,
    blocklist: Blocklist,
    keypoint: float,
    key: Key[jax.Array, ""],
    *,
    must_fit: bool,
) -> int | None:
    """The candidate that is executed in algorithm 7; None for none.

    - signature: the best, which counts the distance from the wanted signature. With ``must_fit``, where the
      fixture's opening is penetrated or all are threaded, only if it leads to that signature (line 9).
    - no_signature, tamp5, tamp50: the best without that, whatever its signature.
    - wang: the only candidate there is, if it can be done (Wang et al. 2015 look at nothing else).
    - nearest: see `nearest_or_random`.

    ``choices`` are those of a question with a wanted signature for "signature" alone; ``blocklist`` is empty.

    Raises:
        ValueError: for a method that is none of algorithm 7.
    """
    if method not in THREADING:
        raise ValueError(
            f"method is {method!r}, expected one of {', '.join(THREADING)}: threading lists no signatures"
        )
    if method == "nearest":
        values = nearest_of(choices, keypoint, key)
        return choices.best(lambda _: values)
    ahead = choices.foreseen() if method in STEPS_AHEAD else np.zeros(len(choices.candidates))
    best = choices.best(lambda one: one.costs(blocklist) + ahead)
    refused = method == "signature" and must_fit and best is not None and not choices.fits()[best]
    return None if refused else best


def stuck_counts(
    method: Method, holding_hands: Float[np.ndarray, "_h 3"], centre: Float[np.ndarray, "3"]
) -> bool:
    """Whether a method regrasps when control is trapped: Wang et al. 2015 only near to the fixture, m."""
    if method != "wang":
        return True
    return bool((np.linalg.norm(holding_hands - centre, axis=-1) < NEAR_FIXTURE).any())


def nearest_of(choices: Choices, keypoint: float, key: Key[jax.Array, ""]) -> Float[np.ndarray, "C"]:
    """`nearest_or_random` of candidates."""
    drawn = np.asarray(jax.random.uniform(key, (len(choices.candidates),)))
    return nearest_or_random(choices.candidates.places, choices.now, keypoint, drawn)


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
