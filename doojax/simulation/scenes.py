"""What is in a scene, as plain data: rope, hands, objects, obstacles and the settings of the solver.

Nothing here imports MuJoCo: `Scene.parts` are what the data stand for, and `doojax.simulation.build` turns
them into a model that every engine runs.
"""

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.geometry.frames import rotate
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.types import Obstacles, ShapeKind

if TYPE_CHECKING:
    from doojax.simulation.layout import Layout
    from doojax.simulation.parts import Part
    from doojax.simulation.parts.arms import ArmBodies
    from doojax.simulation.parts.hands import Hands
    from doojax.simulation.parts.ropes import Rope

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


def sphere(radius: float, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Shape:
    """A ball (m): a capsule without a straight part."""
    return Shape(ShapeKind.CAPSULE, (radius, radius, 0.0), offset)


@dataclass(frozen=True)
class Obstacle:
    """A rigid body that is placed by data: moving it compiles nothing."""

    name: str
    shapes: tuple[Shape, ...]
    friction: float = 0.0  # the rope's friction counts where it is larger

    @property
    def height(self) -> float:
        """How far its origin is above its lowest point when it stands upright, m."""
        return max(
            shape.half_size[2]
            + (shape.half_size[0] if shape.kind == ShapeKind.CAPSULE else 0.0)
            - shape.offset[2]
            for shape in self.shapes
        )


@dataclass(frozen=True)
class Gripper:
    """A hand that holds one end of a link and is pulled towards a moving target with a bounded force.

    The bound is what makes it stop or slide at an obstacle instead of going through, and what keeps the
    rope from being overstretched.
    """

    link: int | None  # index of the rope link held; None: a hand that holds nothing, and pushes
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
class Cylinder:
    """A rigid body that stands upright on the floor, and is pushed about; its pose is state."""

    radius: float  # m
    height: float  # m
    mass: float  # kg
    friction: float  # Coulomb coefficient against floor, hands and other bodies

    def __post_init__(self):
        """Refuse values without a physical meaning."""
        for name, value in vars(self).items():
            if not (value >= 0 if name == "friction" else value > 0):
                raise ValueError(
                    f"a cylinder's {name} is {value}, expected {'>= 0' if name == 'friction' else '> 0'}"
                )


@dataclass(frozen=True)
class Arms:
    """A robot with a fixed base, in the place of free hands; its tools hold what `Scene.grasps` lets them."""

    # MJCF, whose actuators are of the types intvelocity or position, see doojax.robots.DUAL_ARM; or URDF, all
    # of whose joints have limits of effort and velocity
    file: str
    tools: tuple[str, ...]  # sites or bodies
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the file's origin, m


@dataclass(frozen=True)
class Attachment:
    """Where a rope is fastened to an obstacle, for good; it may turn there. Moving the obstacle moves it."""

    obstacle: str  # its name; one without shapes is a mere place
    link: int  # of the rope
    end: Literal[-1, 0, 1]  # which end of the link: -1 towards link 0, +1 towards the last link, 0 its centre


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
    cone: Literal["elliptic", "pyramidal"] = "elliptic"  # pyramids: up to 29 % less friction, quicker
    contact_time: float = 0.01  # s, time constant of contacts and holds; at least two time steps
    max_contact_points: int = 20  # kept by MJX, most penetrating first; MuJoCo C keeps all


@dataclass(frozen=True)
class Scene:
    """Everything that is compiled; positions, obstacle poses and rope parameters are data."""

    name: str
    rope_model: RopeModel | None  # None: there is no rope
    rope: RopeParameters | None
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
    cylinders: tuple[Cylinder, ...] = field(default=(), repr=False)  # repr: see `digest`
    arms: Arms | None = field(default=None, repr=False)
    grasps: bool = field(
        default=False, repr=False
    )  # may hands hold the rope anywhere: doojax.simulation.grasps
    attachments: tuple[Attachment, ...] = field(default=(), repr=False)
    grasp_hold: Literal["point", "rigid"] = field(default="point", repr=False)  # a point lets the rope turn

    def __post_init__(self):
        """Refuse a rope without a model, and grippers that hold a link the rope lacks."""
        if (self.rope is None) != (self.rope_model is None):
            raise ValueError(
                f"rope_model is {self.rope_model} and rope {self.rope}: expected both, or None twice"
            )
        if self.cylinders and (self.rope is not None or len(self.grippers) != 1):
            raise ValueError(
                f"scene {self.name!r} has cylinders, {len(self.grippers)} hands and "
                f"{'no' if self.rope is None else 'a'} rope: expected one hand that pushes, and no rope"
            )
        if self.arms and (self.grippers or self.rope is None or self.planar):
            raise ValueError(
                f"scene {self.name!r} has arms and {len(self.grippers)} free hands: expected arms alone, and "
                "a rope in space"
            )
        if self.grasps and self.rope is None:
            raise ValueError(f"scene {self.name!r} has grasps and no rope: expected something to grasp")
        for one in self.attachments:
            known = [obstacle.name for obstacle in self.obstacles]
            if one.obstacle not in known or not 0 <= one.link < self.links:
                raise ValueError(
                    f"an attachment fastens link {one.link} to {one.obstacle!r}, expected one of "
                    f"{self.links} links and one of the obstacles {', '.join(known)}"
                )
        for index, gripper in enumerate(self.grippers):
            if gripper.link is not None and not 0 <= gripper.link < self.links:
                there = f"the rope's links are 0 to {self.links - 1}" if self.links else "there is no rope"
                raise ValueError(f"gripper {index} holds link {gripper.link}, but {there}")

    @property
    def digest(self) -> str:
        """Differs where anything here does: data that were simulated otherwise are told by it.

        Kinds of parts that came later count where there are any, so that data of before keep theirs.
        """
        text = repr(self) + (repr(self.cylinders) if self.cylinders else "") + "grasps" * self.grasps
        if self.arms:  # what the file says, wherever it is
            content = hashlib.sha256(Path(self.arms.file).read_bytes()).hexdigest()
            text += repr(replace(self.arms, file=content))
        text += repr(self.attachments) if self.attachments else ""
        text += "" if self.grasp_hold == "point" else self.grasp_hold
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @cached_property
    def parts(self) -> "tuple[Part, ...]":
        """What the scene is made of, in the order in which it is added."""
        from doojax.simulation.parts.attachments import Attachments
        from doojax.simulation.parts.cylinders import Cylinders
        from doojax.simulation.parts.grasps import Grasps
        from doojax.simulation.parts.surroundings import Floor, ObstacleBodies

        planar_rope = self.rope is not None and self.planar  # which cannot leave its plane
        return (
            *([Floor()] if self.floor and not planar_rope else []),
            ObstacleBodies(self.obstacles),
            *([self.rope_part] if self.rope is not None else []),
            self.driver,
            *([Cylinders(self.cylinders)] if self.cylinders else []),
            *([Attachments(self.attachments)] if self.attachments else []),
            *(
                [Grasps(self.driver.bodies, self.driver.anchors, self.links, self.grasp_hold)]
                if self.grasps
                else []
            ),
        )

    @cached_property
    def rope_part(self) -> "Rope":
        """The rope. Raises ValueError where there is none."""
        from doojax.simulation.parts.ropes import Rope

        if self.rope_model is None or self.rope is None:
            raise ValueError(f"scene {self.name!r} has no rope")
        return Rope(self.rope_model, self.rope)

    @cached_property
    def driver(self) -> "Hands | ArmBodies":
        """The part that actions move."""
        from doojax.simulation.parts.arms import ArmBodies
        from doojax.simulation.parts.hands import Hands

        if self.arms:
            return ArmBodies(self.arms)
        return Hands(self.grippers, self.planar)

    @cached_property
    def layout(self) -> "Layout":
        """Where everything is in the state; compiles the scene when it is first asked."""
        from doojax.simulation.build import build_model
        from doojax.simulation.layout import Layout

        return Layout.of(self, build_model(self))

    @property
    def links(self) -> int:
        """Of the rope; 0 where there is none."""
        return 0 if self.rope_model is None else self.rope_model.links

    @property
    def planar(self) -> bool:
        """Do the hands, and what they handle, move in a horizontal plane only?"""
        return bool(self.cylinders) or (
            self.rope_model is not None and self.rope_model.kind == "planar_chain"
        )

    @property
    def plane_height(self) -> float:
        """Of a planar scene: how high the centres of all that moves are, m."""
        return self.cylinders[0].radius if self.cylinders else self.rope_part.parameters.radius

    @property
    def friction(self) -> float:
        """Coulomb's coefficient of what the hands handle."""
        return self.cylinders[0].friction if self.cylinders else self.rope_part.parameters.friction

    @property
    def nq(self) -> int:
        """Number of generalised positions."""
        return self.layout.nq

    @property
    def nv(self) -> int:
        """Number of degrees of freedom."""
        return self.layout.nv

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
    return primitives_at(scene.obstacles, position, quaternion)


def primitives_at(
    bodies: tuple[Obstacle, ...], position: Float[Array, "B 3"], quaternion: Float[Array, "B 4"]
) -> Obstacles:
    """`obstacles_at` of bodies that need not be a scene's."""
    body = np.array([b for b, obstacle in enumerate(bodies) for _ in obstacle.shapes], dtype=int)
    shapes = [shape for obstacle in bodies for shape in obstacle.shapes]
    offset = jnp.array([shape.offset for shape in shapes], dtype=jnp.float32).reshape(-1, 3)
    return Obstacles(
        kind=jnp.array([int(shape.kind) for shape in shapes], dtype=jnp.int32),
        centre=position[body] + rotate(quaternion[body], offset),
        quaternion=quaternion[body],
        half_size=jnp.array([shape.half_size for shape in shapes], dtype=jnp.float32).reshape(-1, 3),
        active=position[body, 2] > -5.0,
    )
