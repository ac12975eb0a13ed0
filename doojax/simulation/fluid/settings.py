"""What a fluid is, and how finely it is computed."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from doojax.geometry.box import Box
from doojax.simulation.fluid.kernels import Kernel

REGION = Box((-1.0, -1.0, -0.5), (2.0, 1.0, 2.0))  # m, in which neighbours are looked up fast


@dataclass(frozen=True)
class FluidSettings:
    """A fluid of equal particles, in space or in the plane x, z."""

    spacing: float = 0.01815  # m, between particles at rest; each stands for a cube (or square) of that side
    dimensions: Literal[2, 3] = 3
    density: float = 1000.0  # kg/m^3
    viscosity: float = 1e-3  # kinematic, m^2/s; water has 1e-6, oil 1e-4, honey 1e-2
    gravity: float = 9.81  # m/s^2, along -z
    time_step: float = 0.0025  # s
    iterations: int = 2  # of the constraint solver in each step
    neighbours: int = 0  # that a particle can have, itself included; 0: as many as the dimensions need
    region: Box = REGION

    def __post_init__(self):
        """Refuse what cannot be simulated."""
        for name in ("spacing", "density", "time_step"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"the fluid's {name} is {getattr(self, name)}, expected a positive number")
        for name in ("viscosity", "gravity"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"the fluid's {name} is {getattr(self, name)}, expected at least 0")
        if self.dimensions not in (2, 3):
            raise ValueError(f"the fluid has {self.dimensions} dimensions, expected 2 or 3")
        if self.iterations < 1 or self.neighbours < 0:
            raise ValueError(
                f"iterations is {self.iterations} and neighbours {self.neighbours}, expected at least 1 and 0"
            )
        if self.smoothing > 1:
            most = self.viscosity / self.smoothing
            raise ValueError(
                f"viscosity {self.viscosity} m^2/s is too large for time steps of {self.time_step} s: "
                f"expected at most {most:.3g} m^2/s, or time steps of {self.time_step / self.smoothing:.3g} s"
            )

    @property
    def radius(self) -> float:
        """How near a particle's centre comes to a wall, m."""
        return self.spacing / 2

    @cached_property
    def kernel(self) -> Kernel:
        """Within 1.8 spacings, as in the released code's scene (radius .033 m, spacing .01815 m)."""
        return Kernel(1.82 * self.spacing, self.dimensions)

    @property
    def volume(self) -> float:
        """That one particle stands for, m^3, or m^2 in the plane."""
        return self.spacing**self.dimensions

    @cached_property
    def crowding(self) -> float:
        """The kernels' sum over a square lattice, times `volume`: what density is a part of."""
        distance = np.linalg.norm(self._lattice, axis=-1)
        return float(self.kernel.value(distance, xp=np).sum() * self.volume)

    @cached_property
    def evenness(self) -> float:
        """What the kernels' slopes over a square lattice make of a slope of one."""
        square = (self._lattice**2).sum(-1)
        slope = -np.asarray(self.kernel.slope(np.sqrt(square), xp=np)) * square
        return float(slope.sum() * self.volume / self.crowding / self.dimensions)

    @property
    def smoothing(self) -> float:
        """XSPH's coefficient, of the difference to the neighbours' mean velocity, from 0 to 1.

        The mean under the kernel differs from the velocity v itself by half the kernel's second moment times
        the Laplacian of v: this much of it, every step, is the viscosity asked for.
        """
        return 2 * self.viscosity * self.time_step / self._second_moment

    @cached_property
    def _second_moment(self) -> float:
        """Of the kernel over a square lattice, along one axis, m^2."""
        lattice = self._lattice
        weight = self.kernel.value(np.linalg.norm(lattice, axis=-1), xp=np) * self.volume / self.crowding
        return float((weight * lattice[..., 0] ** 2).sum())

    @property
    def _lattice(self) -> np.ndarray:
        """Offsets of a particle's neighbours at rest, m."""
        reach = np.arange(-3, 4) * self.spacing
        return np.stack(np.meshgrid(*[reach] * self.dimensions), axis=-1)

    @property
    def capacity(self) -> int:
        """Neighbours of a particle that are kept."""
        return self.neighbours or (40 if self.dimensions == 3 else 24)

    def require_speed(self, speed: float, thinnest: float) -> None:
        """Is the time step short enough for particles so fast (m/s) beside walls so thin (m)?

        Raises:
            ValueError: a particle could pass through a wall in one step.
        """
        # a centre keeps the radius from a wall, and what goes in by less than half of it comes out again
        way = self.radius + thinnest / 2
        if speed * self.time_step > way:
            raise ValueError(
                f"steps of {self.time_step} s are too long: at {speed:.3g} m/s a particle goes "
                f"{speed * self.time_step:.3g} m in one, and could pass through a wall of {thinnest:.3g} m; "
                f"expected at most {way / speed:.3g} s"
            )
