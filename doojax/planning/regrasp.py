"""Grasp candidates: what each gripper does, and where along the rope. Thesis section 5.4.2, PlanGrasp.

Each gripper has a strategy, and candidates are all valid combinations of strategies, each with several places
along the rope. Nothing here simulates; `doojax.planning.regrasp_costs` prices what comes of a candidate.
"""

import itertools
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

SAME_PLACE = 0.025  # along the rope: nearer places are one


class Strategy(IntEnum):
    """What a gripper does in a regrasp."""

    STAY = 0  # holds what it holds, or nothing
    GRASP = 1  # held nothing, and grasps
    MOVE = 2  # lets go, and grasps elsewhere
    RELEASE = 3  # lets go


type Strategies = tuple[Strategy, ...]


class Candidates(NamedTuple):
    """C candidates for G grippers."""

    strategies: Int[np.ndarray, "C G"]
    places: Float[np.ndarray, "C G"]  # along the rope, that each then holds; NaN for nothing

    def __len__(self) -> int:
        return len(self.strategies)

    @property
    def holding(self) -> Bool[np.ndarray, "C G"]:
        """Which grippers then hold the rope."""
        return ~np.isnan(self.places)

    @property
    def moving(self) -> Bool[np.ndarray, "C G"]:
        """Which grippers go somewhere."""
        return np.isin(self.strategies, (Strategy.GRASP, Strategy.MOVE))

    @property
    def let_go(self) -> Bool[np.ndarray, "C G"]:
        """Which grippers let go of the rope at first."""
        return np.isin(self.strategies, (Strategy.MOVE, Strategy.RELEASE))


def strategies_of(holding: Sequence[bool]) -> list[Strategies]:
    """The valid combinations, given which grippers hold the rope now.

    Not valid: nobody holds the rope afterwards; nobody does anything; all let go; more than one goes
    somewhere.
    """
    options = [
        (Strategy.STAY, Strategy.MOVE, Strategy.RELEASE) if held else (Strategy.STAY, Strategy.GRASP)
        for held in holding
    ]
    return [one for one in itertools.product(*options) if _is_valid(one, holding)]


def _is_valid(strategies: Strategies, holding: Sequence[bool]) -> bool:
    going = [one for one in strategies if one in (Strategy.GRASP, Strategy.MOVE)]
    kept = [held and one == Strategy.STAY for one, held in zip(strategies, holding, strict=True)]
    acts = any(one != Strategy.STAY for one in strategies)
    return acts and len(going) <= 1 and (bool(going) or any(kept))


def sampled_places(key: Key[Array, ""], count: int, keypoint: float) -> Float[np.ndarray, "count"]:
    """Places to grasp at: the keypoint, the rope's beginning, its end unless that is the keypoint, and
    others that are uniform."""
    fixed = [keypoint, 0.0, *([1.0] if keypoint != 1 else [])]
    drawn = np.asarray(jax.random.uniform(key, (count,)), float)
    drawn[: len(fixed)] = fixed[:count]
    return drawn


def candidates_of(
    places_now: Sequence[float], key: Key[Array, ""], count: int, keypoint: float
) -> Candidates:
    """Candidates from where grippers hold the rope now (NaN: nowhere).

    Args:
        places_now: of each gripper.
        key: for places; each combination of strategies has its own.
        count: of places for each combination in which a gripper goes somewhere; others are one candidate.
        keypoint: along the rope.

    Raises:
        ValueError: for a count below 1.
    """
    if count < 1:
        raise ValueError(f"count is {count}, expected 1 or more places for each combination of strategies")
    now = np.asarray(places_now, float)
    found, places = [], []
    for index, combination in enumerate(strategies_of((~np.isnan(now)).tolist())):
        goes = [one in (Strategy.GRASP, Strategy.MOVE) for one in combination]
        sampled = sampled_places(jax.random.fold_in(key, index), count, keypoint) if any(goes) else [np.nan]
        for place in sampled:
            found.append(combination)
            kept = np.where(np.array(combination) == Strategy.RELEASE, np.nan, now)
            places.append(np.where(goes, place, kept))
    return Candidates(np.array(found, int), np.array(places))


def alternating_candidates(
    places_now: Sequence[float], key: Key[Array, ""], count: int, keypoint: float, spread: float = 0.04
) -> Candidates:
    """Candidates in which the hand that holds nothing grasps, and the other then lets go.

    That is what threading does: places are near to the keypoint. Where nobody holds the rope, each hand may
    grasp.

    Args:
        places_now: of each gripper along the rope, NaN for nothing.
        key: for places.
        count: of places for each hand that may grasp: the first is the keypoint.
        keypoint: along the rope.
        spread: standard deviation of places; those beyond the rope's ends are reflected.

    Raises:
        ValueError: for a count below 1, or where every hand holds the rope.
    """
    if count < 1:
        raise ValueError(f"count is {count}, expected 1 or more places for each hand that may grasp")
    now = np.asarray(places_now, float)
    free = np.flatnonzero(np.isnan(now))
    if not free.size:
        raise ValueError(f"hands hold the rope at {now.tolist()}: to alternate, one must hold nothing")
    strategies, places = [], []
    for hand in free.tolist():
        normal = np.asarray(jax.random.normal(jax.random.fold_in(key, hand), (count,)), float)
        drawn = keypoint + spread * normal
        drawn[0] = keypoint
        drawn = np.abs(drawn)
        drawn = np.clip(np.where(drawn > 1, 2 - drawn, drawn), 0, 1)
        for place in drawn.tolist():
            own = [Strategy.STAY if np.isnan(held) else Strategy.RELEASE for held in now]
            own[hand] = Strategy.GRASP
            strategies.append(tuple(own))
            places.append([place if other == hand else np.nan for other in range(len(now))])
    return Candidates(np.array(strategies, int), np.array(places, float))


def stays_put(candidates: Candidates, places_now: Sequence[float]) -> Bool[np.ndarray, "C"]:
    """Candidates in which a gripper goes back to where it held the rope: they change nothing."""
    near = np.abs(candidates.places - np.asarray(places_now, float)) < SAME_PLACE
    return (near & candidates.moving).any(1)


def geodesic(places: Float[np.ndarray, "*b G"], keypoint: float) -> Float[np.ndarray, "*b"]:
    """The least distance along the rope from a gripper to the keypoint; infinite where nobody holds it."""
    apart = np.abs(np.asarray(places, float) - keypoint)
    return np.asarray(np.where(np.isnan(apart), np.inf, apart).min(-1))


def got_stuck(now: Sequence[float], best: Sequence[float], keypoint: float) -> bool:
    """Whether the signature goes on the blocklist (algorithm 6, line 10): no grasp is found that is nearer to
    the keypoint than the present one. The released code asks for nearer by `SAME_PLACE`; so does this, since
    the same place is no progress."""
    before, after = geodesic(np.asarray(now), keypoint), geodesic(np.asarray(best), keypoint)
    return bool(np.isfinite(before) and after >= before - SAME_PLACE)


def points_at(rope: Float[Array, "N1 3"], place: Float[Array, ""]) -> Float[Array, "3"]:
    """The point of a rope, given where its equal links meet, at a place from 0 to 1."""
    links = len(rope) - 1
    along = jnp.clip(place, 0, 1) * links
    link = jnp.clip(jnp.floor(along).astype(int), 0, links - 1)
    return rope[link] + (along - link) * (rope[link + 1] - rope[link])
