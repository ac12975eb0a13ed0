"""Polylines: length, resampling, curvature; and the shapes that heavy ropes take in closed form."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from doojax.geometry.frames import safe_norm

_NEWTON_STEPS = 8


def arc_lengths(points: Float[Array, "N 3"]) -> Float[Array, "N"]:
    """Length along a polyline from its first point to each of its points, metres; the last is the whole."""
    lengths = _lengths(points[1:] - points[:-1])
    return jnp.concatenate([jnp.zeros(1, points.dtype), jnp.cumsum(lengths)])


def resample(points: Float[Array, "N 3"], count: int) -> Float[Array, "count 3"]:
    """``count`` points at equal arc length along a polyline, its ends included; differentiable.

    Corners between the new points are cut, so the result is never longer. A polyline without length gives
    copies of its point.

    Raises:
        ValueError: if ``count`` or the number of points is less than two.
    """
    if count < 2 or len(points) < 2:
        raise ValueError(f"cannot resample {len(points)} points to {count}: both must be at least two")
    along = arc_lengths(points)
    targets = along[-1] * jnp.linspace(0, 1, count)
    left = jnp.clip(jnp.searchsorted(along, targets, side="right") - 1, 0, len(points) - 2)
    length = along[left + 1] - along[left]
    fraction = jnp.where(length > 0, (targets - along[left]) / jnp.where(length > 0, length, 1), 0)
    resampled = points[left] + fraction[:, None] * (points[left + 1] - points[left])
    return resampled.at[-1].set(points[-1])


def turning_angles(points: Float[Array, "N 3"]) -> Float[Array, "N-2"]:
    """Angle between successive segments at each inner point, radians in [0, pi]."""
    before, after = points[1:-1] - points[:-2], points[2:] - points[1:-1]
    return jnp.arctan2(_lengths(jnp.cross(before, after)), jnp.sum(before * after, axis=-1))


def curvatures(points: Float[Array, "N 3"]) -> Float[Array, "N-2"]:
    """Curvature at each inner point, 1/metres: change of the unit tangent over the mean segment length.

    Exact where the points lie on a circle at equal steps; steps h give at most 2/h, where the polyline folds
    back on itself. Segments without length give NaN.
    """
    steps = points[1:] - points[:-1]
    lengths = _lengths(steps)
    tangents = steps / lengths[:, None]
    return _lengths(tangents[1:] - tangents[:-1]) / ((lengths[1:] + lengths[:-1]) / 2)


def _lengths(vectors: Float[Array, "N 3"]) -> Float[Array, "N"]:
    return safe_norm(*jnp.moveaxis(vectors, -1, 0))


def catenary(
    start: Float[Array, "3"], end: Float[Array, "3"], length: float | Float[Array, ""], count: int
) -> Float[Array, "count 3"]:
    """An inextensible, perfectly flexible rope hung from two points: ``count`` points at equal arc length.

    In float32 accurate to 2e-6 of the length from 0.1 % slack on, to 4e-5 where it is tauter. Ends one above
    the other make a vertical fold. A rope shorter than the distance between its ends is drawn straight, that
    is, stretched.

    Args:
        start: world frame (gravity along -z), metres; the first point.
        end: the last point.
        length: of the rope, metres.
        count: number of points, ends included.

    Raises:
        ValueError: if ``count`` is below two.
    """
    if count < 2:
        raise ValueError(f"count is {count}: expected at least two points, the ends")
    across = end - start
    span = jnp.maximum(safe_norm(across[0], across[1]), 1e-6 * length)
    rise = across[2]
    # sinh(x) / x = ratio, with x = span / (2 a): Newton on the logarithm, which is convex and nearly linear.
    ratio = jnp.sqrt(jnp.maximum(length**2 - rise**2, span**2 * (1 + 1e-6))) / span
    x = jnp.where(ratio < 3, jnp.sqrt(6 * (ratio - 1)), jnp.log(2 * ratio) + jnp.log(jnp.log(2 * ratio)))
    for _ in range(_NEWTON_STEPS):
        error = jnp.log(jnp.sinh(x) / x / ratio)
        x = jnp.maximum(x - error / (1 / jnp.tanh(x) - 1 / x), 1e-4)
    a = span / (2 * x)

    middle = jnp.arctanh(jnp.clip(rise / length, -0.999999, 0.999999))
    u_start = jnp.sinh(middle - x)  # arc length from the lowest point, over a
    along = jnp.linspace(0, 1, count) * length / a
    u = u_start + along
    horizontal = jnp.arcsinh(u) - jnp.arcsinh(u_start)
    vertical = along * (u + u_start) / (jnp.sqrt(1 + u**2) + jnp.sqrt(1 + u_start**2))
    direction = jnp.append(across[:2] / span, 0)
    up = jnp.array([0.0, 0.0, 1.0])
    curve = start[None] + a * (horizontal[:, None] * direction[None] + vertical[:, None] * up[None])
    straight = start[None] + jnp.linspace(0, 1, count)[:, None] * across[None]
    return jnp.where(length > safe_norm(*across), curve, straight).at[-1].set(end)


def clamped_elastica(
    length: float, bending_stiffness: float, weight_per_length: float, count: int
) -> np.ndarray:
    """The shape of a heavy inextensible rope clamped horizontally at one end: a reference, on the host.

    The rope leaves the origin along +x and sags in the xz plane, its far end free. With theta its inclination
    at arc length s, EI theta'' = w (length - s) cos(theta). In t = (length - s) (w / EI)^(1/3) and
    phi = theta + pi / 2 that is phi'' = t sin(phi) without parameters, so one shot from the free end, stopped
    where the rope is horizontal, solves the rope whose length it then has: a root search over phi at the free
    end finds ours. It takes the logarithm of phi, which a limp rope makes tiny.

    Args:
        length: metres.
        bending_stiffness: EI, newton metres squared.
        weight_per_length: w, newtons per metre.
        count: number of points, ends included.

    Returns:
        points [count, 3] at equal arc length, metres, in double precision, accurate to 1e-8 of the length.
        The tip's deflection is ``-points[-1, 2]``; for a stiff rope it tends to w length^4 / (8 EI).

    Raises:
        ValueError: if an argument is not positive, ``count`` is below two, or w length^3 / EI is not within
            1e-6 to 1e5, where the solver was tested.
    """
    from scipy.integrate import solve_ivp  # on first use: a reference should not slow every import
    from scipy.optimize import brentq

    if not min(length, bending_stiffness, weight_per_length) > 0 or count < 2:
        raise ValueError(
            f"length {length}, bending stiffness {bending_stiffness}, weight per length {weight_per_length}: "
            f"expected positive numbers; count {count}: expected at least two"
        )
    limpness = weight_per_length * length**3 / bending_stiffness
    if not 1e-6 <= limpness <= 1e5:
        raise ValueError(
            f"w length^3 / EI is {limpness:.3g}, expected 1e-6 to 1e5: change a unit or the rope"
        )
    reach = limpness ** (1 / 3)  # the clamp's t

    def slope(t, state):  # of phi, phi', and the position seen from the tip, all in the units of t
        phi, bend = state[:2]
        return [bend, t * np.sin(phi), np.sin(phi), np.cos(phi)]

    def horizontal(t, state):
        return state[0] - np.pi / 2

    horizontal.terminal = True  # pyright: ignore[reportFunctionMemberAccess]

    def shoot(log_tip_phi, end, **options):
        tip_phi = np.exp(log_tip_phi)
        tolerances = {"rtol": 1e-11, "atol": 1e-12 * tip_phi}
        return solve_ivp(slope, (0, end), [tip_phi, 0, 0, 0], method="DOP853", **tolerances, **options)

    def excess(log_tip_phi):
        return shoot(log_tip_phi, 2 * reach + 2, events=horizontal).t[-1] - reach

    limp = -2 / 3 * limpness**0.5 - 5  # beyond the asymptotic growth of phi'' = t phi (Airy's equation)
    stiff = np.log(np.pi / 2) - 1e-13
    tip = brentq(excess, limp, stiff, xtol=1e-13)
    _, _, x, z = shoot(tip, reach, t_eval=np.linspace(0, reach, count)).y
    shape = np.stack([x[-1] - x, np.zeros(count), z - z[-1]], axis=-1)[::-1]
    return shape * (length / reach)
