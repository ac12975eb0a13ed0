"""Voxel grids: occupancy of obstacles and rasters of a state's points, computed where they are needed.

Nothing is cut out of a stored grid: a crop is a `Grid` with another origin, evaluated directly, so it is as
true outside any workspace as inside.
"""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from doojax.geometry.frames import safe_norm
from doojax.geometry.rounding import require_digits
from doojax.geometry.sdf import signed_distance
from doojax.modules import Jittable
from doojax.types import Obstacles


class Grid(Jittable):
    """Cubic voxels with faces along the world's axes; voxel arrays are indexed [x, y, z].

    The origin is data (moving the grid compiles nothing); resolution and shape are part of the program.
    """

    origin: Float[Array, "3"]  # lowest corner, not centre, of voxel (0, 0, 0); world frame, metres
    resolution: float = eqx.field(static=True)  # edge of a voxel, metres
    shape: tuple[int, int, int] = eqx.field(static=True)  # voxels along x, y, z

    def __check_init__(self):
        """Refuse grids without volume."""
        if not self.resolution > 0:
            raise ValueError(f"resolution is {self.resolution}, expected a positive voxel edge in metres")
        if min(self.shape) < 1:
            raise ValueError(f"shape is {self.shape}, expected at least one voxel along each axis")

    def centres(self) -> Float[Array, "X Y Z 3"]:
        """World positions of the voxels' centres, metres."""
        return jnp.stack(jnp.meshgrid(*self.axes(), indexing="ij"), axis=-1)

    def axes(self) -> tuple[Float[Array, "X"], Float[Array, "Y"], Float[Array, "Z"]]:
        """The voxels' centres along x, y and z, metres."""
        x, y, z = (
            self.origin[axis] + self.resolution * (jnp.arange(self.shape[axis]) + 0.5) for axis in range(3)
        )
        return x, y, z


def grid_covering(
    low: tuple[float, float, float], high: tuple[float, float, float], resolution: float
) -> Grid:
    """The smallest grid from the corner ``low`` that reaches at least to ``high``, metres.

    Raises:
        ValueError: if the resolution is not positive, ``high`` does not exceed ``low`` along each axis, or
            they are so far from the origin that they would be rounded to more than a tenth of a voxel.
    """
    if not resolution > 0:
        raise ValueError(f"resolution is {resolution}, expected a positive voxel edge in metres")
    advice = "subtract a common origin from all coordinates before they become arrays of JAX"
    require_digits("a grid", advice, np.array([low, high]), allowed=resolution / 10)
    # The small tolerance keeps 1.25 / 0.01 at 125 voxels where rounding makes it 125.0000001.
    x, y, z = (math.ceil((top - bottom) / resolution - 1e-6) for bottom, top in zip(low, high, strict=True))
    return Grid(jnp.array(low, float), resolution, (x, y, z))


def crop(grid: Grid, centre: Float[Array, "3"], shape: tuple[int, int, int]) -> Grid:
    """The part of ``grid``'s lattice, continued without end, that surrounds a point.

    Its voxels coincide with those of ``grid`` (up to rounding), and its middle lies within half a voxel of
    ``centre`` along each axis.

    Args:
        grid: gives the lattice; its shape is not used, and the crop may leave it.
        centre: world frame, metres.
        shape: voxels of the crop along x, y, z.
    """
    steps = jnp.round((centre - grid.origin) / grid.resolution - jnp.array(shape) / 2)
    return Grid(grid.origin + steps * grid.resolution, grid.resolution, shape)


def occupancy(obstacles: Obstacles, grid: Grid) -> Bool[Array, "X Y Z"]:
    """Which voxels an active obstacle may touch.

    A voxel counts when its centre lies within half a voxel's diagonal of an obstacle. Every voxel that an
    obstacle touches then counts, however thin the obstacle, at the price of some that it narrowly misses:
    obstacles look fatter by at most 0.87 voxels.
    """
    return signed_distance(obstacles, grid.centres()) <= grid.resolution * 3**0.5 / 2


def gaussian_raster(
    points: Float[Array, "N 3"], grid: Grid, sharpness: float | Float[Array, ""] = 2000.0
) -> Float[Array, "X Y Z"]:
    """Smooth image of a point set: exp(-sharpness d^2), d from voxel centre to the nearest point, metres.

    The default, per square metre, falls to one half at 1.9 cm. Differentiable in the points.
    """
    return jnp.exp(-sharpness * _nearest_distance(points, grid) ** 2)


def inverse_log_raster(
    points: Float[Array, "N 3"], grid: Grid, scale: float | Float[Array, ""] = 0.01
) -> Float[Array, "X Y Z"]:
    """Image of a point set with long tails: 1 / (1 + log(1 + d / scale)), d to the nearest point, metres.

    Thesis section 2.3.7.2 asks for values "proportional to the inverse-log" of the distance; that they are
    one at the points and one half at 1.7 scales is our reading of it. Differentiable in the points, but for a
    cusp where a voxel's centre meets one.
    """
    return 1 / (1 + jnp.log1p(_nearest_distance(points, grid) / scale))


def _nearest_distance(points: Float[Array, "N 3"], grid: Grid) -> Float[Array, "X Y Z"]:
    x, y, z = (
        points[:, axis, None] - centres[None] for axis, centres in enumerate(grid.axes())
    )  # each [N, voxels along the axis]
    distances = safe_norm(x[:, :, None, None], y[:, None, :, None], z[:, None, None, :])
    return jnp.min(distances, axis=0)
