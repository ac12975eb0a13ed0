"""Which hand holds the rope where, or nothing: data, changed inside a rollout by pure functions.

For scenes with ``grasps=True``, on every engine and per element of a batch; nothing is compiled anew. A place
is a fraction of the rope: 0 at the beginning of link 0, 1 at the end of the last.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from doojax.geometry.frames import safe_norm
from doojax.parts import traced
from doojax.simulation.build import build_model
from doojax.simulation.layout import Observation
from doojax.simulation.scenes import Scene
from doojax.simulation.state import SimState

FIELD = "eq_data"  # of the model: where on hand and link an equality acts
REACH = 0.05  # m, between a hand and what it grasps


def graspable(scene: Scene, state: SimState) -> SimState:
    """A state, of one element, in which hands hold nothing of what they can grasp, with the data for it.

    Raises:
        ValueError: the scene is one without grasps.
    """
    ids, own = _holds(scene)
    first = _offset(scene)
    data = jnp.asarray(build_model(scene).eq_data, state.qpos.dtype)
    data = data.at[ids.ravel(), first : first + 3].set(0)
    let_go = state.holding.at[own].set(False)
    return eqx.tree_at(
        lambda s: (s.holding, s.model_fields), state, (let_go, state.model_fields | {FIELD: data})
    )


def grasped(
    scene: Scene,
    state: SimState,
    hand: int | Int[Array, ""],
    place: Any,
    turn: Float[Array, "4"] | None = None,
) -> SimState:
    """The state in which a hand holds the rope at ``place``, 0 to 1 along it, and nowhere else.

    The constraint closes what gap there is within some hundredths of a second: see `check_grasp`.

    Args:
        scene: one with grasps.
        state: of one element, from `graspable`.
        hand: index of the hand; may be traced.
        place: may be traced.
        turn: of the link in the hand, a unit quaternion: of rigid holds alone, which keep it, see
            `doojax.simulation.engines.mujoco.MujocoSimulator.turn_in_hand`.

    Raises:
        ValueError: for a scene without grasps or a state that is not `graspable`, or a turn where holds are
            none that keep it, or none where they are; outside of jit, for a hand that the scene lacks, or a
            place beyond the rope's ends.
    """
    if (turn is None) != (scene.grasp_hold == "point"):
        raise ValueError(
            f"turn is {turn}, and hands of scene {scene.name!r} hold the rope by a "
            f"{'point, which lets it turn: expected none' if turn is not None else 'rigid hold: give one'}"
        )
    ids, own = _holds(scene)
    _check_hand(ids, state, hand)
    if not traced(place) and not 0 <= float(place) <= 1:
        raise ValueError(
            f"place is {float(place):.6g}, expected 0 to 1: from one end of the rope to the other"
        )
    links = ids.shape[1]
    along = jnp.asarray(place, state.qpos.dtype) * links  # links from the rope's beginning
    link = jnp.clip(jnp.floor(along).astype(int), 0, links - 1)
    offset = jnp.clip(along - jnp.arange(links) - 0.5, -0.5, 0.5) * scene.rope_part.parameters.length / links
    holds = state.holding[own].reshape(ids.shape).at[hand].set(jnp.arange(links) == link)
    data = state.model_fields[FIELD].at[jnp.asarray(ids)[hand], _offset(scene)].set(offset)
    if turn is not None:
        data = data.at[jnp.asarray(ids)[hand], 6:10].set(jnp.asarray(turn, data.dtype))
    return eqx.tree_at(
        lambda s: (s.holding, s.model_fields),
        state,
        (
            state.holding.at[own].set(holds.ravel()),
            state.model_fields | {FIELD: data},
        ),
    )


def released(scene: Scene, state: SimState, hand: int | Int[Array, ""]) -> SimState:
    """The state in which a hand holds nothing. Arguments and errors as for `grasped`."""
    ids, own = _holds(scene)
    _check_hand(ids, state, hand)
    holds = state.holding[own].reshape(ids.shape).at[hand].set(False)
    return eqx.tree_at(lambda s: s.holding, state, state.holding.at[own].set(holds.ravel()))


def grasp_places(scene: Scene, state: SimState) -> Float[Array, "G"]:
    """Where each hand holds the rope; NaN for one that holds nothing."""
    ids, own = _holds(scene)
    _check_hand(ids, state, 0)
    links = ids.shape[1]
    holds = state.holding[own].reshape(ids.shape)
    offset = state.model_fields[FIELD][ids, _offset(scene)] * links / scene.rope_part.parameters.length
    place = jnp.where(holds, (jnp.arange(links) + 0.5 + offset) / links, 0).sum(-1)
    return jnp.where(holds.any(-1), place, jnp.nan)


def rope_point(scene: Scene, seen: Observation, place: float | Float[Array, ""]) -> Float[Array, "3"]:
    """The point of the rope at a place, m, in the world."""
    links = scene.links
    along = jnp.asarray(place, seen.hands.dtype) * links
    link = jnp.clip(jnp.floor(along).astype(int), 0, links - 1)
    axis = seen.half_links[link] / safe_norm(*seen.half_links[link])
    pitch = scene.rope_part.parameters.length / links
    return seen.state.points[link] + (along - link - 0.5) * pitch * axis


def check_grasp(scene: Scene, seen: Observation, hand: int, place: float, reach: float = REACH) -> None:
    """Say whether a hand can grasp the rope at ``place``, outside of jit.

    Raises:
        ValueError: the point is farther from the hand than it reaches.
    """
    gap = float(safe_norm(*(rope_point(scene, seen, place) - seen.hands[hand])))
    if gap > reach:
        raise ValueError(
            f"hand {hand} is {gap:.3g} m from the rope at {place:.3g}, expected at most {reach:g} m: move it "
            "there first"
        )


def _offset(scene: Scene) -> int:
    """The first of the three numbers of an equality's data that say where on a link it acts."""
    return 0 if scene.grasp_hold == "rigid" else 3


def _holds(scene: Scene) -> tuple[np.ndarray, slice]:
    """Ids of the equalities by hand and link, and where they are in `SimState.holding`."""
    places = scene.layout.places
    if "grasps" not in places:
        raise ValueError(f"scene {scene.name!r} has no grasps: make it with grasps=True")
    before = list(places).index("grasps")
    first = sum(len(one.holds) for one in list(places.values())[:before])
    ids = places["grasps"].holds.reshape(-1, scene.links)
    return ids, slice(first, first + ids.size)


def _check_hand(ids: np.ndarray, state: SimState, hand: Any) -> None:
    if FIELD not in state.model_fields:
        raise ValueError("the state has no data of grasps: make it with graspable(scene, state)")
    if not traced(hand) and not 0 <= int(hand) < len(ids):
        raise ValueError(f"hand is {int(hand)}, expected 0 to {len(ids) - 1}")
