"""What is in a scene, as plain data: rope, grippers, obstacles and the settings of the solver.

Nothing here imports MuJoCo; `doojax.simulation.build` turns a `Scene` into a model that every engine runs.
"""

import hashlib
from dataclasses import dataclass, field
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from doojax.geometry.frames import rotate
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.types import Obstacles, ShapeKind

PARKED_POSITION = (0.0, 0.0, -10.0)
PARKED_QUATERNION = (
    0.5**0.5,
    0.0,
    -(0.5**0.5),
    0.0,
)  # +x up: a parked wall is a floor far below


@dataclass(frozen=True)
class Shape:
    """One primitive of an obstacle, in the obstacle's frame."""

    kind: ShapeKind
    half_size: tuple[float, float, float]  # m, see ShapeKind
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wall: bool = False  # a box of which only the +x face can be reached: simulated as that face's plane


@dataclass(frozen=True)
class Obstacle:
    """A rigid body that is placed by data: moving it compiles nothing."""

    name: str
    shapes: tuple[Shape, ...]
    friction: float = 0.0  # the rope's friction counts where it is larger


@dataclass(frozen=True)
class Gripper:
    """A hand that holds one end of a link and is pulled towards a moving target with a bounded force.

    The bound is what makes it stop or slide at an obstacle instead of going through, and what keeps the
    rope from being overstretched.
    """

    link: int  # index of the rope link held
    end: Literal[-1, 0, 1]  # which end of the link: -1 towards link 0, +1 towards the last link, 0 its centre
    radius: float  # m
    max_force: float  # N
    max_speed: float  # m/s
    inertia: float = 1.0  # kg, that the controller moves: hand and arm
    stiffness: float = 2500.0  # N/m, of the position controller
    hold: Literal["point", "rigid"] = "point"  # a point lets the rope turn in the hand

    @property
    def lead(self) -> float:
        """Metres along an axis that a command can be ahead of the hand: beyond, the force is at its bound."""
        return self.max_force / self.stiffness


@dataclass(frozen=True)
class SolverSettings:
    """MuJoCo's solver; the same values serve every engine, because results depend on them.

    The defaults converge: Newton's method takes 2 to 4 iterations of most steps, and the bounds are there for
    the rest. A solver that is cut off earlier lets ropes gain energy and gives any friction at all.
    """

    algorithm: Literal["newton", "cg"] = "newton"
    iterations: int = 50
    line_search_iterations: int = 50
    tolerance: float = 1e-8  # of an iteration's improvement, below which it stops; warp: at least 1e-6
    cone: Literal["elliptic", "pyramidal"] = "elliptic"  # pyramids: up to 29 % less friction, derivatives
    contact_time: float = 0.01  # s, time constant of contacts and holds; at least two time steps
    max_contact_points: int = 20  # kept by MJX, most penetrating first; MuJoCo C keeps all


@dataclass(frozen=True)
class Scene:
    """Everything that is compiled; positions, obstacle poses and rope parameters are data."""

    name: str
    rope_model: RopeModel
    rope: RopeParameters
    grippers: tuple[Gripper, ...]
    obstacles: tuple[Obstacle, ...] = ()
    floor: bool = True  # at z = 0
    timestep: float = 0.004  # s
    substeps: int = 250  # physics steps in a control period
    gravity: float = 9.81  # m/s^2
    viscosity: float = 0.0  # of the medium, Pa s: drag that stands for all that calms a swinging rope
    integrator: Literal["euler", "rk4"] = (
        "euler"  # rk4 keeps the energy of an undamped rope, at 4 times the cost
    )
    solver: SolverSettings = field(default_factory=SolverSettings)

    def __post_init__(self):
        """Refuse grippers that hold a link the rope lacks."""
        for index, gripper in enumerate(self.grippers):
            if not 0 <= gripper.link < self.rope_model.links:
                raise ValueError(
                    f"gripper {index} holds link {gripper.link}, but the rope's links are 0 to "
                    f"{self.rope_model.links - 1}"
                )

    @property
    def digest(self) -> str:
        """Differs where anything here does: data that were simulated otherwise are told by it."""
        return hashlib.sha256(repr(self).encode()).hexdigest()[:16]

    @property
    def planar(self) -> bool:
        """Do rope and grippers move in a horizontal plane only?"""
        return self.rope_model.kind == "planar_chain"

    @property
    def nq(self) -> int:
        """Number of generalised positions: the rope's, then each gripper's."""
        free_root = self.rope_model.kind == "capsule_chain"
        return self.nv + int(free_root)  # a quaternion has four numbers

    @property
    def nv(self) -> int:
        """Number of degrees of freedom."""
        links, hands = self.rope_model.links, len(self.grippers)
        rope = {"planar_chain": links + 2, "capsule_chain": 3 * links + 3, "point_masses": 3 * links}
        return rope[self.rope_model.kind] + (2 if self.planar else 3) * hands

    def hands(self, qpos: Shaped[Any, "*b nq"]) -> Shaped[Any, "*b G D"]:
        """The grippers' world coordinates (m) among generalised positions; D is 2 in a plane, else 3."""
        count, axes = len(self.grippers), 2 if self.planar else 3
        return qpos[..., self.nq - count * axes :].reshape(*qpos.shape[:-1], count, axes)

    @property
    def control_period(self) -> float:
        """Seconds of physics per action."""
        return self.timestep * self.substeps


def parked_poses(count: int) -> tuple[Float[Array, "{count} 3"], Float[Array, "{count} 4"]]:
    """Positions and quaternions (w, x, y, z) that take ``count`` obstacles out of the scene."""
    return jnp.tile(jnp.array(PARKED_POSITION), (count, 1)), jnp.tile(
        jnp.array(PARKED_QUATERNION), (count, 1)
    )


def obstacles_at(scene: Scene, position: Float[Array, "B 3"], quaternion: Float[Array, "B 4"]) -> Obstacles:
    """The primitives of the scene's B obstacle bodies at the given poses (world frame, m; (w, x, y, z)).

    A body below z = -5 m counts as parked: its primitives are inactive.
    """
    body = np.array([b for b, obstacle in enumerate(scene.obstacles) for _ in obstacle.shapes], dtype=int)
    shapes = [shape for obstacle in scene.obstacles for shape in obstacle.shapes]
    offset = jnp.array([shape.offset for shape in shapes], dtype=jnp.float32).reshape(-1, 3)
    return Obstacles(
        kind=jnp.array([int(shape.kind) for shape in shapes], dtype=jnp.int32),
        centre=position[body] + rotate(quaternion[body], offset),
        quaternion=quaternion[body],
        half_size=jnp.array([shape.half_size for shape in shapes], dtype=jnp.float32).reshape(-1, 3),
        active=position[body, 2] > -5.0,
    )
