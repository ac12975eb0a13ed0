"""The kernel by which particles weigh each other, and how much of it a wall cuts off."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

DEGREE = 7  # of the polynomial that stands for the part behind a wall: off by less than 1e-4


@dataclass(frozen=True)
class Kernel:
    """Wendland's C2, (1 - q)^4 (1 + 4 q) with q = r / reach: smooth, and it does not pair particles."""

    reach: float  # m
    dimensions: int

    @property
    def peak(self) -> float:
        """Its value at r = 0, 1/m^D, which makes its integral one."""
        return (7 / math.pi if self.dimensions == 2 else 21 / (2 * math.pi)) / self.reach**self.dimensions

    def value(self, r: Float[Any, "*n"], xp: Any = jnp) -> Any:
        """At a distance (m), 1/m^D."""
        left = xp.maximum(1 - r / self.reach, 0)
        return self.peak * (left * left) * (left * left) * (1 + 4 * r / self.reach)

    def slope(self, r: Float[Any, "*n"], xp: Any = jnp) -> Any:
        """Its derivative by distance, divided by the distance, 1/m^(D+2): times an offset, the gradient."""
        left = xp.maximum(1 - r / self.reach, 0)
        return -20 * self.peak / self.reach**2 * left * left * left

    @cached_property
    def _behind(self) -> np.ndarray:
        """Coefficients, of q, highest first, of the part beyond a plane at the distance q reach."""
        step, count = self.reach / 4000, 4000
        r = (np.arange(count) + 0.5) * step
        distances = np.linspace(0, 1, 65)[:-1] * self.reach
        density = self.value(r, xp=np)
        part = []
        for d in distances:
            beyond = r > d
            cosine = d / r[beyond]
            # of the circle (or sphere) of radius r, what lies beyond the plane
            share = (
                2 * r[beyond] * np.arccos(cosine)
                if self.dimensions == 2
                else 2 * np.pi * r[beyond] ** 2 * (1 - cosine)
            )
            part.append((density[beyond] * share).sum() * step)
        left = 1 - distances / self.reach
        # as (1 - q)^4 times a polynomial, so that it ends smoothly
        return np.polyfit(distances / self.reach, np.array(part) / left**4, DEGREE, w=left**4)

    def behind(self, distance: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """The part of the kernel beyond a plane at a distance (m), at least 0; and its derivative, 1/m."""
        q = jnp.clip(distance / self.reach, 0.0, 1.0)
        value, slope = jnp.full_like(q, self._behind[0]), jnp.zeros_like(q)
        for coefficient in self._behind[1:]:
            slope = slope * q + value
            value = value * q + coefficient
        left = 1 - q
        cubed = left * left * left
        return value * cubed * left, (slope * left - 4 * value) * cubed / self.reach
