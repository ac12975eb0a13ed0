"""A rope as a part of a scene; its bodies come from `doojax.simulation.rope`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.geometry.frames import quaternion_multiply, rotate
from doojax.simulation.parts.base import Frames, Part, Places, Turn, find_frames, put
from doojax.simulation.rope import (
    ROOT,
    RopeModel,
    RopeParameters,
    add_floor_friction,
    add_rope,
    link_name,
    stabilise_root,
)

if TYPE_CHECKING:
    import mujoco

    from doojax.simulation.layout import Observation
    from doojax.simulation.scenes import Scene


@dataclass(frozen=True)
class Rope(Part):
    """Links in a row."""

    model: RopeModel
    parameters: RopeParameters

    def add(self, spec: "mujoco.MjSpec", scene: "Scene") -> None:
        """Add the links and, in a plane, their friction on the floor."""
        rope, last = self.parameters, self.model.links - 1
        rigid = {(gripper.link, gripper.end) for gripper in scene.grippers if gripper.hold == "rigid"}
        add_rope(spec, self.model, rope, height=rope.radius, clamped=((0, -1) in rigid, (last, 1) in rigid))
        if scene.floor and scene.planar:
            add_floor_friction(spec, self.model, rope, scene.gravity, scene.solver.contact_time)

    def finish(self, model: "mujoco.MjModel") -> None:
        """What MJCF cannot say of a rope, written into the compiled model."""
        stabilise_root(model)

    def frames(self) -> tuple[Frames, ...]:
        """The links' centres and their axes."""
        links = tuple(link_name(index) for index in range(self.model.links))
        return Frames("body", links), Frames("axis", links)

    def find(self, model: "mujoco.MjModel") -> Places:
        """``qpos`` are those of the root, or of all point masses, [N, 3]."""
        if self.model.kind == "capsule_chain":
            joints = [model.joint(ROOT)]
        elif self.model.kind == "planar_chain":
            joints = [model.joint(f"{ROOT}_{axis}") for axis in ("x", "y", "yaw")]
        else:
            names = [link_name(index) for index in range(self.model.links)]
            joints = [model.joint(f"{name}_{axis}") for name in names for axis in "xyz"]
        free = self.model.kind == "capsule_chain"
        qpos = np.concatenate([one.qposadr[0] + np.arange(7 if free else 1) for one in joints])
        dofs = np.concatenate([one.dofadr[0] + np.arange(6 if free else 1) for one in joints])
        shape = (-1, 3) if self.model.kind == "point_masses" else (-1,)
        return Places(
            frames=find_frames(model, self.frames()),
            qpos=qpos.reshape(shape),
            dofs=dofs.reshape(shape),
            sizes=np.array([model.geom(link_name(0)).id]),  # all links' are alike
        )

    def see(
        self,
        vectors: list[Float[Array, "*b _ 3"]],
        coordinates: Float[Array, "*b C"],
        sizes: Float[Array, "*b 1 2"],
    ) -> dict[str, Array]:
        """Points, the half links from a link's centre to where its front cap begins, and the radius."""
        points, axes = vectors
        half_length = sizes[..., 0, 1]  # zero for spheres
        return {
            "points": points,
            "half_links": axes * half_length[..., None, None],
            "radius": sizes[..., 0, 0],
        }

    def samples(self, seen: "Observation") -> list[tuple[Float[Array, "P 3"], Float[Array, "P"]]]:
        """On the links' axes: centres, ends and half way. An edge between two samples is missed by less than
        pitch^2 / (128 radius), 1 mm for the thickest link here."""
        steps = jnp.linspace(-1.0, 1.0, 5)[:, None, None]
        links = (seen.state.points + steps * seen.half_links).reshape(-1, 3)
        return [(links, jnp.full(len(links), seen.radius))]

    def moved(self, places: Places, qpos: Array, qvel: Array, turn: Turn) -> tuple[Array, Array]:
        """A root's angular velocity is its own frame's, or about z: it stays."""
        here = qpos[places.qpos]
        if self.model.kind == "point_masses":  # whose positions are in the world
            return (
                put(qpos, places.qpos, turn.points(here)),
                put(qvel, places.dofs, turn.vectors(qvel[places.dofs])),
            )
        if self.model.kind == "planar_chain":
            origin = jnp.array([self.root_offset, 0.0, 0.0])
            at = jnp.append(here[:2], 0.0) + origin
            point = rotate(turn.quaternion, at) + turn.translation - origin
            root, linear = jnp.stack([point[0], point[1], here[2] + turn.yaw]), places.dofs[:2]
        else:
            place = rotate(turn.quaternion, here[:3]) + turn.translation
            root = jnp.concatenate([place, quaternion_multiply(turn.quaternion, here[3:])])
            linear = places.dofs[:3]
        return put(qpos, places.qpos, root), put(qvel, linear, turn.vectors(qvel[linear]))

    @property
    def root_offset(self) -> float:
        """Where a chain's root link lies along x in the model's reference pose, m."""
        links, length = self.model.links, self.parameters.length
        return (links // 2 + 0.5) * length / links - length / 2

    def along(self, link: int, end: int) -> float:
        """Where a link's end (-1, 1) or centre (0) lies along x in the reference pose, m."""
        pitch = self.parameters.length / self.model.links
        return (link + 0.5 + end / 2) * pitch - self.parameters.length / 2
