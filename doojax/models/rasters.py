"""What a network with convolutions sees: voxels around the rope, of obstacles and of the state's components.

Thesis section 2.3.7.2. The voxels are computed where they are needed, not cut out of a stored grid, and their
middle is exactly the local origin, so that what is seen does not depend on where in the world it lies (the
thesis snaps its crops to the grid of the workspace, and sees nothing outside of it).
"""

from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.geometry.sdf import signed_distance
from doojax.geometry.voxels import Grid, inverse_log_raster
from doojax.models.local import Origin, local_origin
from doojax.modules import Jittable
from doojax.types import Depth, Obstacles, RopeState, Size

SHARPNESS = 2000.0  # per square metre: a raster falls to one half at 1.9 cm


@dataclass(frozen=True)
class ViewConfig:
    """What an `Encoder` sees, and how large it is. `view` has those of the two tasks."""

    grippers: Size
    origin: Origin
    across: Size  # voxels along x and along y
    up: Size  # voxels along z
    resolution: float  # edge of a voxel, m
    raster: Literal["gaussian", "inverse log"] = "gaussian"
    """exp(-2000 d^2), d metres to the component's nearest point (code), or what the text asks for."""
    layers: Depth = 3  # of convolutions
    channels: Size = 26  # of every layer
    kernel_up: Size = 3  # voxels along z; along x and y a kernel has 3
    pool_up: Size = 2  # along z; along x and y 2

    def __post_init__(self):
        """Refuse a grid of which the convolutions leave nothing."""
        if min(self.left) < 1:
            raise ValueError(
                f"of {self.across} x {self.across} x {self.up} voxels, {self.layers} convolutions leave "
                f"{self.left[0]} across and {self.left[1]} up, expected at least 1: take more voxels or "
                "fewer layers"
            )

    @property
    def left(self) -> tuple[int, int]:
        """Voxels across and up after all layers."""
        across, up = self.across, self.up
        for _ in range(self.layers):
            across, up = max(across - 2, 0) // 2, max(up - self.kernel_up + 1, 0) // self.pool_up
        return across, up

    @property
    def features(self) -> int:
        """Numbers that an `Encoder` gives."""
        across, up = self.left
        return across * across * up * self.channels

    @property
    def inputs(self) -> int:
        """Channels of the voxel grid: obstacles, rope, each gripper."""
        return 2 + self.grippers


def view(preset: Literal["quick", "thesis"], grippers: int) -> ViewConfig:
    """The view of the task with one gripper (dragging), or with two.

    `thesis`: 100 x 100 x 4 voxels of 1 cm, or 40 x 40 x 40 of 2 cm. `quick`: half as many along each axis,
    twice as large, 8 channels, and with two grippers one layer less, for which there is no room.
    """
    if grippers not in (1, 2):
        raise ValueError(f"grippers is {grippers}, expected 1 or 2; give your own ViewConfig for others")
    if grippers == 1:
        flat = ViewConfig(1, "gripper", 100, 4, 0.01, kernel_up=1, pool_up=1)
        small = ViewConfig(1, "gripper", 50, 2, 0.02, channels=8, kernel_up=1, pool_up=1)
        return flat if preset == "thesis" else small
    if preset == "thesis":
        return ViewConfig(2, "centroid", 40, 40, 0.02)
    return ViewConfig(2, "centroid", 20, 20, 0.04, channels=8, layers=2)


def rasterise(obstacles: Obstacles, state: RopeState, config: ViewConfig) -> Float[Array, "Z X Y c"]:
    """The voxel grid around a state's local origin; channels: obstacles, rope, each gripper.

    A voxel is occupied (1, else 0) where its centre lies inside an obstacle or within half a voxel's edge of
    one, so that no wall along the grid is too thin to be seen. (The released code asks Gazebo whether a
    sphere of 1 mm touches something, which misses thin parts.) The other channels are smooth images of
    points, see `ViewConfig.raster`; only they are differentiable. The vertical axis comes first.
    """
    shape = (config.across, config.across, config.up)
    corner = local_origin(state, config.origin) - config.resolution * jnp.array(shape) / 2
    grid = Grid(corner, config.resolution, shape)
    x, y, z = grid.axes()
    centres = jnp.stack(
        [
            jnp.broadcast_to(along, (config.up, config.across, config.across))
            for along in (x[:, None], y, z[:, None, None])
        ],
        axis=-1,
    )
    occupied = signed_distance(obstacles, jax.lax.stop_gradient(centres)) <= config.resolution / 2
    components = [state.points, *state.grippers[:, None]]
    if config.raster == "gaussian":
        images = [gaussian_image(points, grid) for points in components]
    else:
        images = [jnp.moveaxis(inverse_log_raster(points, grid), 2, 0) for points in components]
    return jnp.stack([occupied.astype(x.dtype), *images], axis=-1)


def gaussian_image(points: Float[Array, "N 3"], grid: Grid) -> Float[Array, "Z X Y"]:
    """`doojax.geometry.voxels.gaussian_raster`, vertical axis first, with far fewer exponentials.

    The exponential of a sum of squares is a product of three, each of which depends on one axis only.
    """
    x, y, z = (
        jnp.exp(-SHARPNESS * (points[:, axis, None] - along[None]) ** 2)
        for axis, along in enumerate(grid.axes())
    )
    return (z[:, :, None, None] * x[:, None, :, None] * y[:, None, None, :]).max(0)


class Encoder(Jittable):
    """Convolutions without padding, ReLU, and the largest of every few voxels; then features of unit scale.

    On a CPU, XLA's convolutions over three axes take ten times as long as those over two: here a kernel's
    layers along z are stacked as channels, and what lies along z is treated like a batch.
    """

    kernels: list[Float[Array, "3 3 i o"]]  # along x, y; i: layers along z, then channels
    biases: list[Float[Array, "o"]]
    config: ViewConfig = eqx.field(static=True)

    def __init__(self, config: ViewConfig, *, key: Array):
        inputs = [config.inputs] + [config.channels] * (config.layers - 1)
        init = jax.nn.initializers.he_normal()
        self.kernels = [
            init(key, (3, 3, config.kernel_up * channels, config.channels))
            for key, channels in zip(jax.random.split(key, config.layers), inputs, strict=True)
        ]
        self.biases = [jnp.zeros(config.channels) for _ in inputs]
        self.config = config

    def __call__(self, obstacles: Obstacles, state: RopeState) -> Float[Array, "f"]:
        """Features of one state and what is around it, of mean 0 and variance 1 among themselves."""
        features = self.convolve(rasterise(obstacles, state, self.config))
        return (features - features.mean()) * jax.lax.rsqrt(features.var() + 1e-5)

    def convolve(self, voxels: Float[Array, "Z X Y c"]) -> Float[Array, "f"]:
        """The features of a voxel grid as the convolutions leave them."""
        for kernel, bias in zip(self.kernels, self.biases, strict=True):
            count = voxels.shape[0] - self.config.kernel_up + 1
            stacked = [voxels[start : start + count] for start in range(self.config.kernel_up)]
            voxels = convolved(jnp.concatenate(stacked, axis=-1), kernel)
            voxels = largest(jax.nn.relu(voxels + bias[None, None, None]), self.config.pool_up)
        return voxels.reshape(-1)


@jax.custom_jvp
def convolved(voxels: Float[Array, "Z X Y i"], kernel: Float[Array, "3 3 i o"]) -> Float[Array, "Z x y o"]:
    """A convolution along x and y, without padding.

    Within a loop, as in training, XLA is fast on a CPU only where axes stand as in "NHWC" and "HWIO". The
    derivatives are written so that what reverse mode makes of them has that order: a step of training takes
    a quarter to a sixth of the time.
    """
    return _convolution(voxels, kernel, ("NHWC", "HWIO", "NHWC"))


@convolved.defjvp
def _convolved_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (voxels, kernel), (voxels_dot, kernel_dot) = primals, tangents
    by_voxels = _convolution(voxels_dot, jnp.swapaxes(kernel, 2, 3), ("NHWC", "HWOI", "NHWC"))
    turned = jnp.transpose(voxels, (3, 1, 2, 0)), jnp.transpose(kernel_dot, (2, 0, 1, 3))
    by_kernel = _convolution(*turned, ("CHWN", "IHWO", "HWNC"))
    return convolved(voxels, kernel), by_voxels + jnp.transpose(by_kernel, (2, 0, 1, 3))


def _convolution(voxels: Array, kernel: Array, axes: tuple[str, str, str]) -> Array:
    return jax.lax.conv_general_dilated(voxels, kernel, (1, 1), "VALID", dimension_numbers=axes)


def largest(voxels: Float[Array, "Z X Y c"], up: int) -> Float[Array, "z x y c"]:
    """The largest of every block of ``up`` x 2 x 2 voxels; what fills no block is left out."""
    z, x, y, channels = voxels.shape
    z, x, y = z // up, x // 2, y // 2
    blocks = voxels[: z * up, : 2 * x, : 2 * y].reshape(z, up, x, 2, y, 2, channels)
    return blocks.max((1, 3, 5))
