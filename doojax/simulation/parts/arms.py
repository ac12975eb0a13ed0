"""A robot's arms as a part of a scene: links that collide, joints that follow velocities with bounded forces.

The bodies are those of a robot's MJCF file. Its actuators become position controllers of the same gain and
force, whose targets run at the commanded velocities, no farther ahead of the joints than 0.02 rad: that is
what MuJoCo's ``intvelocity`` does with its windup bounded, but without a state besides `SimState.commanded`.
Joints get the inertia of drives, as much as keeps controller and damping stable at the scene's time step.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from doojax.simulation.parts.base import Frames, Part, Places, Turn, find_frames
from doojax.simulation.rope import FLOOR_CONTACT, OBSTACLE_CONTACT

if TYPE_CHECKING:
    from doojax.simulation.layout import Observation
    from doojax.simulation.scenes import Arms, Scene

PREFIX = "robot_"  # of all names of the file
LEAD = 0.02  # rad, that a target is ahead of its joint at most
TOOL_RADIUS = 0.02  # m, of the ball around a tool that counts as what touches obstacles


@dataclass(frozen=True)
class ArmBodies(Part):
    """The arms of a scene."""

    arms: "Arms"

    def _spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(self.arms.file)

    def add(self, spec: mujoco.MjSpec, scene: "Scene") -> None:
        """Attach the file's bodies, with controllers and inertias as the module says."""
        robot = self._spec()
        gains = {one.target: one.gainprm[0] for one in robot.actuators}
        for actuator in robot.actuators:
            actuator.dyntype, actuator.actdim = mujoco.mjtDyn.mjDYN_NONE, 0
            actuator.ctrlrange, actuator.actlimited = list(actuator.actrange), False
        for joint in robot.joints:
            step, gain = scene.timestep, gains.get(joint.name, 0.0)
            joint.armature = max(gain * step**2, joint.damping[0] * step, joint.armature, 1e-4)
        for geom in robot.geoms:
            geom.contype, geom.conaffinity = 0, OBSTACLE_CONTACT | FLOOR_CONTACT
            geom.friction = [scene.friction, 0, 0]
        spec.attach(robot, prefix=PREFIX, frame=spec.worldbody.add_frame(pos=list(self.arms.position)))

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies that carry the tools."""
        return tuple(PREFIX + self._spec().site(name).parent.name for name in self.arms.tools)

    @cached_property
    def anchors(self) -> tuple[tuple[float, float, float], ...]:
        """Where the tools are on those bodies, m."""
        found = (self._spec().site(name).pos for name in self.arms.tools)
        return tuple((float(x), float(y), float(z)) for x, y, z in found)

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Names, in the file, of the joints that actions move, in the order of actions."""
        return tuple(one.target for one in self._spec().actuators)

    def frames(self) -> tuple[Frames, ...]:
        """The tools."""
        return (Frames("site", tuple(PREFIX + name for name in self.arms.tools)),)

    def find(self, model: mujoco.MjModel) -> Places:
        """``qpos`` are the driven joints', [U]."""
        joints = [model.joint(PREFIX + name) for name in self.joints]
        every = [model.joint(PREFIX + one.name) for one in self._spec().joints]
        return Places(
            frames=find_frames(model, self.frames()),
            qpos=np.array([one.qposadr[0] for one in joints], dtype=int),
            dofs=np.array([one.dofadr[0] for one in joints], dtype=int),
            coordinates=np.sort([one.qposadr[0] for one in every]).astype(int),
        )

    def see(
        self,
        vectors: list[Float[Array, "*b _ 3"]],
        coordinates: Float[Array, "*b C"],
        sizes: Float[Array, "*b Z 2"],
    ) -> dict[str, Array]:
        """The tools are the grippers, beside all joints, those of fingers too.

        What tools hold is data, see `doojax.simulation.grasps`.
        """
        (tools,) = vectors
        return {"grippers": tools, "hold_points": tools[..., :0, :], "joints": coordinates}

    def samples(self, seen: "Observation") -> list[tuple[Float[Array, "P 3"], Float[Array, "P"]]]:
        """The tools: of the links `doojax.robots` knows more."""
        return [(seen.hands, jnp.full(len(self.arms.tools), TOOL_RADIUS, seen.hands.dtype))]

    def moved_command(self, commanded: Array, turn: Turn) -> Array:
        """As it was: arms are fixed to the world."""
        return commanded

    def drive(self, scene: "Scene", at: Any, commanded: Any, action: Any, xp: Any = jnp) -> tuple[Any, Any]:
        """Controls at each of S physics steps of a period, and what is then commanded.

        Args:
            scene: whose period it is.
            at: ``[*b, U]``, the driven joints, rad.
            commanded: ``[*b, U]``, their targets so far, rad.
            action: ``[*b, U]``, velocities, rad/s; the largest possible where they are larger.
            xp: jax.numpy or numpy.

        Returns:
            ``[*b, S, U]`` and ``[*b, U]``.
        """
        low, high, speed = (xp.asarray(values, dtype=at.dtype) for values in self._limits)
        start = xp.clip(commanded, at - LEAD, at + LEAD)
        elapsed = xp.arange(1, scene.substeps + 1, dtype=at.dtype)[:, None] * scene.timestep
        moved = start[..., None, :] + elapsed * xp.clip(action, -speed, speed)[..., None, :]
        targets = xp.clip(moved, low, high)
        return targets, targets[..., -1, :]

    @cached_property
    def _limits(self) -> tuple[tuple[float, ...], ...]:
        ranges = [(*one.actrange, min(np.abs(one.ctrlrange))) for one in self._spec().actuators]
        return tuple(tuple(float(value) for value in column) for column in zip(*ranges, strict=True))
