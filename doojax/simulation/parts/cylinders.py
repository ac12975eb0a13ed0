"""Rigid cylinders that stand on the floor and are pushed about."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from doojax.simulation.parts.base import Frames, Part, Places, Turn, find_frames, put
from doojax.simulation.rope import FLOOR_CONTACT, OBSTACLE_CONTACT

if TYPE_CHECKING:
    from doojax.simulation.layout import Observation
    from doojax.simulation.scenes import Cylinder, Scene


@dataclass(frozen=True)
class Cylinders(Part):
    """Upright for good: they slide and turn about z, and the floor carries them.

    Upright cylinders on one plane touch each other as spheres of their radii do whose centres are on one
    level, and spheres are cheap and exact in every engine. Each rests on the floor by one point, with
    Coulomb's friction whatever the direction; what turns it about z is resisted as a disc is that presses
    evenly, by 2/3 of friction times weight times radius.
    """

    cylinders: tuple["Cylinder", ...]

    def add(self, spec: mujoco.MjSpec, scene: "Scene") -> None:
        """Add a body for each, in a row along x."""
        slides = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}
        for index, one in enumerate(self.cylinders):
            body = spec.worldbody.add_body(name=_name(index), pos=[0, 0, one.radius])
            body.mass, body.ipos, body.explicitinertial = one.mass, [0, 0, 0], True
            across = one.mass * (one.radius**2 / 4 + one.height**2 / 12)
            body.inertia = [across, across, one.mass * one.radius**2 / 2]
            for axis, direction in slides.items():
                body.add_joint(
                    name=f"{_name(index)}_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction
                )
            body.add_joint(
                name=f"{_name(index)}_yaw",
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=[0, 0, 1],
                frictionloss=2 / 3 * one.friction * one.mass * scene.gravity * one.radius,
            )
            body.add_geom(
                name=_name(index),
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[one.radius, 0, 0],
                contype=OBSTACLE_CONTACT,
                conaffinity=OBSTACLE_CONTACT | FLOOR_CONTACT,
                friction=[one.friction, 0, 0],
                condim=3,
            )

    def frames(self) -> tuple[Frames, ...]:
        """The centres."""
        return (Frames("body", tuple(_name(index) for index in range(len(self.cylinders)))),)

    def find(self, model: mujoco.MjModel) -> Places:
        """``qpos`` are x, y, z and yaw, [N, 4]; x and y from the centre of the world, z from the floor."""
        joints = [[model.joint(f"{body}_{axis}") for axis in ("x", "y", "z", "yaw")] for body in self._names]
        dofs = np.array([[one.dofadr[0] for one in row] for row in joints], dtype=int)
        return Places(
            frames=find_frames(model, self.frames()),
            qpos=np.array([[one.qposadr[0] for one in row] for row in joints], dtype=int),
            dofs=dofs,
            coordinates=(model.nq + dofs[:, :3]).reshape(-1),
        )

    def see(
        self,
        vectors: list[Float[Array, "*b _ 3"]],
        coordinates: Float[Array, "*b C"],
        sizes: Float[Array, "*b Z 2"],
    ) -> dict[str, Array]:
        """Centres and their velocities."""
        velocities = coordinates.reshape(*coordinates.shape[:-1], len(self.cylinders), 3)
        return {"positions": vectors[0], "velocities": velocities}

    def samples(self, seen: "Observation") -> list[tuple[Float[Array, "P 3"], Float[Array, "P"]]]:
        """The centres."""
        return [(seen.state.positions, jnp.array([one.radius for one in self.cylinders]))]

    def moved(self, places: Places, qpos: Array, qvel: Array, turn: Turn) -> tuple[Array, Array]:
        """Slides are places in the plane; the turn about z adds to the yaws."""
        here = qpos[places.qpos]
        flat = turn.points(here[:, :2])
        here = jnp.concatenate([flat, here[:, 2:3], here[:, 3:] + turn.yaw], axis=1)
        linear = places.dofs[:, :2]
        return put(qpos, places.qpos, here), put(qvel, linear, turn.vectors(qvel[linear]))

    @property
    def _names(self) -> list[str]:
        return [_name(index) for index in range(len(self.cylinders))]


def mass(radius: float, height: float, density: float = 1000.0) -> float:
    """Of a cylinder, kg; MuJoCo's density (kg/m^3) where none is given."""
    return math.pi * radius**2 * height * density


def _name(index: int) -> str:
    return f"cylinder{index}"
