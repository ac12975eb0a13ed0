"""Grasp loops and their signature: thesis section 5.2, algorithms 4 and 5.

The graph has a base, grippers and attachments as vertices. A tether joins the base to each gripper (an arm's
skeleton) and to each attachment (a fixed path through the environment); the rope joins grippers and
attachments that are neighbours on it. Two neighbours, of which at least one is a gripper, make a grasp loop:
base, tether, rope, tether, base. These are the cycles of three vertices that algorithm 4 extracts.

The base may be any point that all tethers share. For agents that fly freely, such as drones that carry a
hose, make it a virtual hub, and let each agent's path be its own position: that is the graph of the thesis's
drones.
"""

import functools
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from doojax.geometry.rounding import require_digits
from doojax.topology.linking import Grid, Points, check_points, crossings, is_closed
from doojax.topology.signatures import Signature, canonical
from doojax.topology.skeletons import Skeleton


class Grasps(eqx.Module):
    """One rope and what holds it: at most G grippers and A attachments, in shapes that do not change.

    A location is a fraction of the rope: 0 its first point, 1 its last, counted in links of equal length.
    Paths lead from the base, which they do not repeat, towards the rope, to whose point the loop continues;
    repeat a path's last point to pad it. What is not active may hold anything. `make_grasps` builds and
    checks one.
    """

    rope: Float[Array, "*b N 3"]  # world frame, metres
    base: Float[Array, "*b 3"]
    gripper_paths: Float[Array, "*b G P 3"]
    gripper_locations: Float[Array, "*b G"]
    gripping: Bool[Array, "*b G"]
    attachment_paths: Float[Array, "*b A Q 3"]
    attachment_locations: Float[Array, "*b A"]
    attached: Bool[Array, "*b A"]


class GraspLoops(eqx.Module):
    """Grasp loops as polylines: at most L = G + A - 1 of them."""

    points: Float[Array, "*b L K 3"]  # closed, padded by repeating points; metres
    holders: Int[Array, "*b L 2"]  # at the ends of the loop's part of the rope; attachments count from G
    active: Bool[Array, "*b L"]


class Holder(NamedTuple):
    """What holds the rope: a gripper or an attachment."""

    location: float  # of the held point, as a fraction of the rope
    path: Points = ()  # [points, 3] from the base, which is not repeated, towards the rope; metres


def make_grasps(
    rope: Points,
    base: Points,
    grippers: Mapping[str, Holder],
    attachments: Mapping[str, Holder] | None = None,
    *,
    max_grippers: int | None = None,
    max_attachments: int | None = None,
) -> Grasps:
    """Check and pad the description of a state.

    Args:
        rope: at least two points, metres.
        base: the point that all paths start from, metres.
        grippers: those that grip, by name.
        attachments: those in place, by name.
        max_grippers: G, if there is room for more than grip now.
        max_attachments: A, likewise.

    Raises:
        ValueError: naming the item: it is not finite or of a wrong shape, two points of the rope in a row are
            the same, a location is outside [0, 1], there are more holders than there is room for, or all is
            so far from the origin that float32 would lose its digits.
    """
    points, origin = check_points(rope, "the rope"), check_points(np.asarray(base)[None], "the base")[0]
    if len(points) < 2:
        raise ValueError(f"the rope has {len(points)} points; expected at least two")
    still = (points[1:] == points[:-1]).all(axis=1)
    if still.any():
        raise ValueError(f"the rope has a link without length at point {np.argmax(still)}; drop that point")
    fields = [
        *_padded(origin, grippers, max_grippers, "gripper"),
        *_padded(origin, attachments or {}, max_attachments, "attachment"),
    ]
    paths = [
        np.reshape(holder.path, (-1, 3)) for holder in (*grippers.values(), *(attachments or {}).values())
    ]
    require_digits(
        "the rope, the base and the paths",
        "subtract a common origin, such as the base, from them and from the skeleton, in numpy.float64",
        points,
        origin,
        *paths,
    )
    return Grasps(*map(jnp.asarray, [points, origin, *fields]))


def _padded(
    base: np.ndarray, holders: Mapping[str, Holder], room: int | None, kind: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Paths, locations and activity of `room` holders."""
    room = len(holders) if room is None else room
    if len(holders) > room:
        raise ValueError(f"{len(holders)} {kind}s ({', '.join(holders)}) are given; there is room for {room}")
    paths, locations = [], np.zeros(room)
    for place, (name, holder) in enumerate(holders.items()):
        if not (isinstance(holder.location, int | float) and 0 <= holder.location <= 1):
            raise ValueError(f"the location of {kind} {name!r} is {holder.location!r}; expected 0 to 1")
        locations[place] = holder.location
        paths.append(np.vstack([base, check_points(holder.path, f"the path of {kind} {name!r}")]))
    longest = max(map(len, paths), default=1)
    padded = np.zeros((room, longest - 1, 3))
    for place, path in enumerate(paths):
        padded[place] = np.pad(path, ((0, longest - len(path)), (0, 0)), mode="edge")[1:]
    return padded, locations, np.arange(room) < len(holders)


def signature(grasps: Grasps, skeleton: Skeleton, *, remove_empty: bool = True) -> Signature:
    """The grasp loop signature of a state: algorithm 4. Jit it, and batch it with `jax.vmap`.

    For each grasp loop the absolute linking numbers with the obstacle loops make a vector; the signature is
    the multiset of the vectors. Holders at one location count as neighbours in the order of their indices.

    Linking numbers add up along shared tethers, so each tether and each part of the rope is compared with the
    skeleton once, however many loops it belongs to. For the same reason algorithm 4's removal, which takes
    one gripper away and starts again, leaves all other vectors as they are: here it is one pass, and which of
    two grippers goes makes no difference.

    Args:
        grasps: the state.
        skeleton: its S obstacle loops.
        remove_empty: leave out loops between two grippers that are linked with nothing.

    Returns:
        at most G + A - 1 vectors. The margin is that of all grasp loops, left out or not; it is NaN, and the
        signature counts as touching, if an active location is outside [0, 1], an obstacle loop is open or a
        coordinate is not finite.
    """
    parts = _parts(grasps)
    obstacles = jnp.where(skeleton.active[:, None, None], skeleton.loops, grasps.base)
    pieces = [parts.gripper_tethers, parts.attachment_tethers, parts.rope]  # each [curves, points, 3]
    points = jnp.concatenate([piece.reshape(-1, 3) for piece in [*pieces, obstacles]]).T
    grid = Grid.over(points)
    # All pieces one after another: a single long curve, some of whose segments are not to be counted.
    curve, loops = jnp.split(grid.snap(points), [sum(piece[..., 0].size for piece in pieces)], axis=1)
    loops = jnp.moveaxis(loops.reshape(3, *obstacles.shape[:2]), 1, 0)
    numbers, squares = jax.vmap(crossings, (None, 0))(curve, loops)

    def per_loop(per_segment, reduce):
        """One value for each loop's first tether, part of the rope and second tether, each [S, L]."""
        per_point = jnp.pad(per_segment, ((0, 0), (0, 1)))
        reduced, end = [], 0
        for piece in pieces:
            start, end = end, end + piece[..., 0].size
            per_curve = per_point[:, start:end].reshape(len(per_segment), *piece.shape[:2])
            reduced.append(reduce(per_curve[:, :, :-1], axis=2))
        tethers = jnp.concatenate(reduced[:2], axis=1)[:, parts.order]
        return tethers[:, :-1], reduced[2], tethers[:, 1:]

    up, along, down = per_loop(numbers, jnp.sum)
    linked = jnp.abs(up + along - down).T
    nearest = functools.reduce(jnp.minimum, per_loop(squares, jnp.min))
    counted = parts.is_loop[None] & skeleton.active[:, None]
    sound = jnp.all(jax.vmap(is_closed)(obstacles))
    margin, touching = grid.margin(jnp.min(nearest, where=counted, initial=jnp.inf), sound)

    used = parts.is_loop
    if remove_empty:
        used &= ~(parts.of_grippers & jnp.all(linked == 0, axis=1))
    rows, count = canonical(linked, used)
    return Signature(rows, count, margin, touching)


def loops_of(grasps: Grasps) -> GraspLoops:
    """The grasp loops as closed polylines: to draw, or for `doojax.topology.linking_of`."""
    parts = _parts(grasps)
    longest = max(parts.gripper_tethers.shape[1], parts.attachment_tethers.shape[1])
    tethers = jnp.concatenate(
        [
            jnp.pad(tether, ((0, 0), (0, longest - tether.shape[1]), (0, 0)), mode="edge")
            for tether in (parts.gripper_tethers, parts.attachment_tethers)
        ]
    )
    tethers = tethers[parts.order]
    points = jnp.concatenate([tethers[:-1], parts.rope, tethers[1:, ::-1]], axis=1)
    return GraspLoops(points, jnp.stack([parts.order[:-1], parts.order[1:]], axis=1), parts.is_loop)


class _Parts(eqx.Module):
    """What loops are made of: loop i goes up tether order[i], along rope i, and down tether order[i + 1]."""

    gripper_tethers: Float[Array, "G T 3"]  # from the base to the rope
    attachment_tethers: Float[Array, "A U 3"]
    rope: Float[Array, "L N 3"]
    order: Int[Array, "H"]  # of the holders along the rope; those that are not active come last
    is_loop: Bool[Array, "L"]
    of_grippers: Bool[Array, "L"]  # both holders are


def _parts(grasps: Grasps) -> _Parts:
    """The graph (algorithm 5): neighbours on the rope make a loop if both are active and one is a gripper."""
    grippers = len(grasps.gripping)
    active = jnp.concatenate([grasps.gripping, grasps.attached])
    location = jnp.concatenate([grasps.gripper_locations, grasps.attachment_locations])
    location = jnp.where((location >= 0) & (location <= 1), location, jnp.nan)
    location = jnp.where(active, location, 0)
    held = jax.vmap(_rope_point, (None, 0))(grasps.rope, location)

    order = jnp.argsort(jnp.where(active, location, jnp.inf))
    ends, held_ends, active_ends, gripper_ends = location[order], held[order], active[order], order < grippers

    # Points of the rope beyond a loop's part of it become that part's ends: repeated points do no harm.
    knots = _knots(grasps.rope)
    knots = knots[None]
    rope = jnp.where((knots > ends[:-1, None])[..., None], grasps.rope[None], held_ends[:-1, None])
    rope = jnp.where((knots < ends[1:, None])[..., None], rope, held_ends[1:, None])

    def tether(path, is_active, end):
        return jnp.concatenate([grasps.base[None], jnp.where(is_active, path, grasps.base), end[None]])

    return _Parts(
        jax.vmap(tether)(grasps.gripper_paths, grasps.gripping, held[:grippers]),
        jax.vmap(tether)(grasps.attachment_paths, grasps.attached, held[grippers:]),
        rope,
        order,
        active_ends[:-1] & active_ends[1:] & (gripper_ends[:-1] | gripper_ends[1:]),
        gripper_ends[:-1] & gripper_ends[1:],
    )


def _knots(rope: Float[Array, "N 3"]) -> Float[Array, "N"]:
    """The locations of a rope's points."""
    return jnp.arange(len(rope), dtype=rope.dtype) / (len(rope) - 1)


def _rope_point(rope: Float[Array, "N 3"], location: Float[Array, ""]) -> Float[Array, "3"]:
    """The point at a location; NaN if that is NaN."""
    scaled = location * (len(rope) - 1)
    link = jnp.clip(jnp.floor(scaled).astype(int), 0, len(rope) - 2)
    return rope[link] + (scaled - link) * (rope[link + 1] - rope[link])
