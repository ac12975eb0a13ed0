"""Whether many joint positions are free of collision: what is far apart is told in little time.

Each capsule meets each obstacle first by bounds: the distance along axes that may separate them from below,
that of three points of the capsule's axis from above. Only where those leave it open is there a search along
the capsule, one pair of each joint position after another, until one touches or none is left. The robot's own
pairs are exact from the first, but for 0.3 mm where two are parallel. Numbers have arrays of their own, with
the batch as their last axis, which is what a CPU computes many of at once.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.frames import quaternion_to_matrix
from doojax.geometry.segment_sdf import segments_are_far
from doojax.robots.kinematics import Numbers, add, frames, turn
from doojax.robots.robot import Robot
from doojax.types import Obstacles, ShapeKind

_TINY = 1e-12  # m^2: an axis whose square is shorter is a point


def are_free(
    robot: Robot,
    joints: Float[Array, "N J"],
    obstacles: Obstacles,
    margin: float | Float[Array, "N"] = 0.0,
    floor: float | None = None,
    slack: Float[Array, "N S"] | None = None,
) -> Bool[Array, "N"]:
    """`doojax.robots.is_free` of N joint positions, in a tenth of the time.

    ``margin`` (m) may differ among them; ``obstacles`` are one set, in the base's frame like ``floor``. With
    ``slack`` (m) each of the robot's capsules may be as far from where it is: free of everything even then.
    """
    centre, half = _axes(robot, joints)
    margin = jnp.broadcast_to(jnp.asarray(margin, joints.dtype), joints.shape[:1])
    radius = robot.capsule_radius[:, None] + (jnp.zeros_like(margin) if slack is None else slack.T)
    least = radius + margin
    free = _clear_of_itself(robot, centre, half, radius, margin)
    if floor is not None:
        free &= (centre[2] - jnp.abs(half[2]) > floor + least).all(0)
    carried = np.array([robot.parents[link] >= 0 for link in robot.capsule_links], bool)
    for shapes, met in ((obstacles, np.ones_like(carried)), (robot.base, carried)):
        if shapes.kind.size and met.any():
            own = tuple(part[met] for part in centre), tuple(part[met] for part in half)
            free = _clear_of(shapes, *own, least[met], free)
    return free


def _axes(robot: Robot, joints: Float[Array, "N J"]) -> tuple[Numbers, Numbers]:
    """Middles of the capsules' axes, and from there to one end; numbers are [S, N]."""
    links = jax.vmap(lambda one: frames(robot, one, range(len(robot.joints))))(joints)
    index = np.array(robot.capsule_links, int)
    position, quaternion = (
        tuple(part.T[index] for part in parts) for parts in (links.position, links.quaternion)
    )
    begin, end = robot.capsule_ends
    middle, half = (
        tuple(one[:, axis, None] for axis in range(3)) for one in ((begin + end) / 2, (end - begin) / 2)
    )
    return add(position, turn(quaternion, middle)), turn(quaternion, half)


def _clear_of_itself(
    robot: Robot, centre: Numbers, half: Numbers, radius: Float[Array, "S N"], margin: Float[Array, "N"]
) -> Bool[Array, "N"]:
    """Whether the axes of pairs are farther apart than their radii and the margin.

    Two fractions of the way say where two segments are nearest: where the lines are, kept within the first
    segment, then the nearest of the second to that, kept within, and the nearest of the first to that again
    (Ericson 2005, 5.1.9).
    """
    if not robot.pairs:
        return jnp.ones(margin.shape, bool)
    first, second = np.array(robot.pairs).T
    one, other = (tuple(part[rows] for part in half) for rows in (first, second))
    gap = tuple(part[first] - part[second] for part in centre)
    squares = ((robot.capsule_ends[1] - robot.capsule_ends[0]) ** 2).sum(-1) / 4
    a, e = (jnp.maximum(squares[rows], _TINY)[:, None] for rows in (first, second))
    b, c, f = _dot(one, other), _dot(one, gap), _dot(other, gap)
    area = a * e - b * b
    parallel = area < 1e-6 * a * e  # to a thousandth: then it matters little where on the first one begins
    s = jnp.where(parallel, 0.0, jnp.clip((b * f - c * e) / jnp.maximum(area, _TINY * _TINY), -1, 1))
    t = jnp.clip((b * s + f) / e, -1, 1)
    s = jnp.clip((b * t - c) / a, -1, 1)
    apart = tuple(g + s * x - t * y for g, x, y in zip(gap, one, other, strict=True))
    reach = radius[first] + radius[second] + margin
    reach = reach + jnp.where(parallel, 1e-3 * (jnp.sqrt(a) + jnp.sqrt(e)), 0.0)
    return ((_dot(apart, apart) > reach * reach) | (reach < 0)).all(0)


def _clear_of(
    shapes: Obstacles, centre: Numbers, half: Numbers, least: Float[Array, "S N"], free: Bool[Array, "N"]
) -> Bool[Array, "N"]:
    """Which of those that are ``free`` so far have all axes farther than ``least`` from the shapes."""
    open_, touching = (part.reshape(-1, len(free)) for part in _bounds(shapes, centre, half, least))
    count, size = shapes.kind.shape[0], centre[0].shape[0]
    free &= ~touching.any(0)
    number = jnp.arange(count * size)[:, None]

    def following(pair: Array, free: Array) -> Array:
        """The next pair of each that is left open; -1 when there is none."""
        return jnp.where(free, jnp.max(jnp.where(open_ & (number < pair), number, -1), axis=0), -1)

    def check(now: tuple[Array, Array]) -> tuple[Array, Array]:
        pair, free = now
        shape, capsule = jnp.divmod(jnp.maximum(pair, 0), size)
        of = partial(_picked, capsule)
        middle, along = tuple(map(of, centre)), tuple(map(of, half))
        begin = tuple(m - h for m, h in zip(middle, along, strict=True))
        step = tuple(2 * h for h in along)
        free &= (pair < 0) | segments_are_far(shapes, shape, begin, step, of(least))
        return following(pair, free), free

    begin = following(jnp.full(free.shape, count * size), free), free
    return jax.lax.while_loop(lambda now: (now[0] >= 0).any(), check, begin)[1]


def _picked(rows: Array, values: Float[Array, "S N"]) -> Float[Array, "N"]:
    return jnp.take_along_axis(values, rows[None], axis=0)[0]


def _bounds(
    shapes: Obstacles, centre: Numbers, half: Numbers, least: Float[Array, "S N"]
) -> tuple[Bool[Array, "M S N"], Bool[Array, "M S N"]]:
    """Which axes may be as near to boxes around the shapes as ``least``, and which are so for certain."""
    rotation = quaternion_to_matrix(shapes.quaternion)
    box = (shapes.kind == ShapeKind.BOX)[:, None, None]
    round_end = jnp.where(shapes.kind == ShapeKind.CAPSULE, shapes.half_size[:, 0], 0)
    size = [shapes.half_size[:, 0], shapes.half_size[:, 1], shapes.half_size[:, 2] + round_end]
    size = [values[:, None, None] for values in size]
    offset = [part[None] - shapes.centre[:, axis, None, None] for axis, part in enumerate(centre)]
    # in the shape's own axes
    at = [sum(rotation[:, i, j, None, None] * offset[i] for i in range(3)) for j in range(3)]
    way = [sum(rotation[:, i, j, None, None] * half[i][None] for i in range(3)) for j in range(3)]
    distance, steps = [jnp.abs(one) for one in at], [jnp.abs(one) for one in way]
    excess = [d - h - s for d, h, s in zip(distance, steps, size, strict=True)]
    reach = jnp.maximum(least, 0)[None]
    near = sum(jnp.maximum(one, 0) ** 2 for one in excess) <= reach * reach
    for i in range(3):  # axes across the capsule's and an edge
        j, k = (i + 1) % 3, (i + 2) % 3
        apart = jnp.abs(at[j] * way[k] - at[k] * way[j])
        near &= apart <= size[j] * steps[k] + size[k] * steps[j] + reach * (steps[j] + steps[k])
    touching = jnp.zeros(near.shape, bool)
    for end in (-1, 0, 1):
        out = [jnp.abs(a + end * w) - s for a, w, s in zip(at, way, size, strict=True)]
        touching |= sum(jnp.maximum(one, 0) ** 2 for one in out) < reach * reach
    touching &= box
    active = shapes.active[:, None, None]
    return near & active & ~touching, touching & active


def _dot(left: Numbers, right: Numbers) -> Array:
    return sum((a * b for a, b in zip(left, right, strict=True)), jnp.zeros_like(left[0]))
