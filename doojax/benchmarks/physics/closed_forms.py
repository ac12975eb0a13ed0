"""The closed forms that simulated ropes are compared with, each with its source. SI units throughout.

The heavy rope hung from two points and the heavy clamped one are `doojax.geometry.curves.catenary` and
`clamped_elastica`.
"""

import math

from scipy.optimize import brentq
from scipy.special import jn_zeros


def hanging_chain_frequency(mode: int, length: float, gravity: float) -> float:
    """Frequency (Hz) of small oscillations of a limp uniform chain (m) hung from one end.

    omega_n = (j_n / 2) sqrt(g / L) with j_n the n-th zero of the Bessel function J0, n from 1: D. Bernoulli,
    Theoremata de oscillationibus corporum filo flexili connexorum, 1732; Lamb, Higher Mechanics, section 85.
    """
    return float(jn_zeros(0, mode)[-1]) / (4 * math.pi) * math.sqrt(gravity / length)


def cantilever_frequency(length: float, bending_stiffness: float, mass: float) -> float:
    """First bending frequency (Hz) of a uniform beam (m, N m^2, kg) clamped at one end.

    omega = k^2 sqrt(EI L^3 / (m L^4)) with cos k cosh k = -1, k = 1.8751: Euler-Bernoulli; Rao, Mechanical
    Vibrations, table of end conditions of beams.
    """
    root = float(brentq(lambda k: math.cos(k) * math.cosh(k) + 1, 1.5, 2.5, xtol=1e-14))  # pyright: ignore
    return root**2 / (2 * math.pi) * math.sqrt(bending_stiffness / (mass * length**3))


def cantilever_deflection(length: float, bending_stiffness: float, weight: float) -> float:
    """Sag (m) of the tip of a stiff beam clamped at one end under its own ``weight`` (N): w L^4 / (8 EI)."""
    return weight * length**3 / (8 * bending_stiffness)


def twist_angle(length: float, twisting_stiffness: float, torque: float) -> float:
    """Angle (rad) by which a torque (N m) twists a shaft (m, GJ in N m^2): T L / GJ, Saint-Venant."""
    return torque * length / twisting_stiffness


def capstan_ratio(friction: float, angle: float) -> float:
    """Tension ahead of a post over tension behind it, of a limp weightless rope sliding around ``angle`` rad.

    exp(mu phi): Euler 1769, Eytelwein 1808.
    """
    return math.exp(friction * angle)


def capstan_friction(ratio: float, angle: float) -> float:
    """The friction coefficient with which `capstan_ratio` would be ``ratio``."""
    return math.log(ratio) / angle


def stopping_distance(speed: float, friction: float, gravity: float) -> float:
    """How far (m) a body at ``speed`` (m/s) slides on a level floor: v^2 / (2 mu g), Coulomb."""
    return speed**2 / (2 * friction * gravity)
