"""A robot's arms as a part of a scene: links that collide, joints that follow velocities with bounded forces.

The bodies are those of a robot's MJCF or URDF file; a URDF file has no actuators and gets some, see
`doojax.simulation.parts.urdf`. Actuators become position controllers of the same gain and
force, whose targets run at the commanded velocities, no farther ahead of the joints than 0.02 rad: that is
what MuJoCo's ``intvelocity`` does with its windup bounded, but without a state besides `SimState.commanded`.
Position controllers stay what they are; what they damp is the velocity that is not commanded. Joints get the
inertia of drives, as much as keeps controller and damping stable at the scene's time step.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from doojax.robots.urdf import JointLimits, urdf_limits
from doojax.simulation.parts.base import Frames, Part, Places, Turn, find_frames
from doojax.simulation.parts.urdf import LEAD, add_controllers
from doojax.simulation.rope import FLOOR_CONTACT, OBSTACLE_CONTACT

if TYPE_CHECKING:
    from doojax.simulation.layout import Observation
    from doojax.simulation.scenes import Arms, Scene

PREFIX = "robot_"  # of all names of the file
TOOL_RADIUS = 0.02  # m, of the ball around a tool that counts as what touches obstacles
SPEED = 1.0  # rad/s or m/s, at most, of joints with position controllers, where files say none


class Drive(NamedTuple):
    """What an actuator does, rad or m."""

    joint: str
    gain: float  # N m/rad
    damping: float  # N m s/rad, of the actuator itself
    low: float  # of its targets
    high: float
    speed: float  # at most, rad/s


@dataclass(frozen=True)
class ArmBodies(Part):
    """The arms of a scene."""

    arms: "Arms"

    def _spec(self) -> mujoco.MjSpec:
        """What the file says, with a site for each tool that is a body."""
        spec = mujoco.MjSpec.from_file(self.arms.file)
        if self._urdf is not None:
            spec.compiler.fusestatic = False  # links that do not move, such as tools, stay what they are
            add_controllers(spec, Path(self.arms.file), self._urdf)
        for name in self.arms.tools:
            if spec.site(name) is None and spec.body(name) is not None:
                spec.body(name).add_site(name=name)
        return spec

    @cached_property
    def _urdf(self) -> dict[str, JointLimits] | None:
        return urdf_limits(Path(self.arms.file))

    def add(self, spec: mujoco.MjSpec, scene: "Scene") -> None:
        """Attach the file's bodies, with controllers and inertias as the module says.

        Raises:
            ValueError: a tool is no site or body of the file, its actuators are none for this, or a joint of
                a URDF file has no limits to make one of.
        """
        for name in self.arms.tools:
            self._site(name)
        robot = self._spec()
        given, wanted = robot.option, spec.option  # how a scene is simulated is not the robot's to say
        for name in dir(given):
            if not name.startswith("_") and not callable(getattr(given, name)):
                setattr(given, name, getattr(wanted, name))
        drives = {one.joint: one for one in self.drives}
        for actuator in robot.actuators:
            if actuator.dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR:
                actuator.dyntype, actuator.actdim = mujoco.mjtDyn.mjDYN_NONE, 0
                actuator.ctrlrange, actuator.actlimited = list(actuator.actrange), False
        for joint in robot.joints:
            step, own = scene.timestep, drives.get(joint.name)
            gain, damping = (own.gain, own.damping) if own else (0.0, 0.0)
            joint.armature = max(gain * step**2, (joint.damping[0] + damping) * step, joint.armature, 1e-4)
        for geom in robot.geoms:
            collides = geom.contype or geom.conaffinity
            geom.contype, geom.conaffinity = 0, (OBSTACLE_CONTACT | FLOOR_CONTACT if collides else 0)
            geom.friction = [scene.friction, 0, 0]
        spec.attach(robot, prefix=PREFIX, frame=spec.worldbody.add_frame(pos=list(self.arms.position)))

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies that carry the tools."""
        return tuple(PREFIX + self._site(name).parent.name for name in self.arms.tools)

    @cached_property
    def anchors(self) -> tuple[tuple[float, float, float], ...]:
        """Where the tools are on those bodies, m."""
        found = (self._site(name).pos for name in self.arms.tools)
        return tuple((float(x), float(y), float(z)) for x, y, z in found)

    def _site(self, name: str) -> Any:
        spec = self._spec()
        found = spec.site(name)
        if found is None:
            sites = ", ".join(site.name for site in spec.sites)
            bodies = ", ".join(body.name for body in spec.bodies if body.name != "world")
            raise ValueError(
                f"{self.arms.file} has no tool {name!r}: expected one of its sites, {sites or 'none'}, or "
                f"bodies, {bodies or 'none'}"
            )
        return found

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Names, in the file, of the joints that actions move, in the order of actions."""
        return tuple(one.joint for one in self.drives)

    @cached_property
    def drives(self) -> tuple[Drive, ...]:
        """What each actuator does.

        Raises:
            ValueError: the file has none, or one that does not make a joint follow a target.
        """
        model = self._spec().compile()
        if not model.nu:
            raise ValueError(
                f"{self.arms.file} has no actuators: give each joint that is to move a position or "
                "intvelocity actuator, as in an MJCF file"
            )
        return tuple(self._drive(model, number) for number in range(model.nu))

    def _drive(self, model: mujoco.MjModel, number: int) -> Drive:
        gain, bias = float(model.actuator_gainprm[number, 0]), model.actuator_biasprm[number]
        integrates = model.actuator_dyntype[number] == mujoco.mjtDyn.mjDYN_INTEGRATOR
        follows = integrates or model.actuator_dyntype[number] == mujoco.mjtDyn.mjDYN_NONE
        follows &= bool(gain > 0 and bias[1] == -gain)
        follows &= model.actuator_biastype[number] == mujoco.mjtBias.mjBIAS_AFFINE
        if not follows or model.actuator_trntype[number] != mujoco.mjtTrn.mjTRN_JOINT:
            raise ValueError(
                f"actuator {model.actuator(number).name or number!r} of {self.arms.file} does not make a "
                "joint follow a target: expected one of the types position and intvelocity, of a joint"
            )
        joint = model.actuator_trnid[number, 0]
        low, high = -np.inf, np.inf
        if integrates:
            low, high = model.actuator_actrange[number]
        elif model.actuator_ctrllimited[number]:
            low, high = model.actuator_ctrlrange[number]
        elif model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
        name = model.joint(joint).name
        own = SPEED if self._urdf is None else self._urdf[name].speed
        speed = np.abs(model.actuator_ctrlrange[number]).min() if integrates else own
        return Drive(name, gain, -float(bias[2]), float(low), float(high), float(speed))

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
        low, high, speed, lag = (xp.asarray(values, dtype=at.dtype) for values in self._limits)
        start = xp.clip(commanded, at - LEAD, at + LEAD)
        elapsed = xp.arange(1, scene.substeps + 1, dtype=at.dtype)[:, None] * scene.timestep
        velocity = xp.clip(action, -speed, speed)[..., None, :]
        moved = start[..., None, :] + elapsed * velocity
        targets = xp.clip(moved, low, high)
        # by what a controller lags that damps velocities
        return targets + xp.where(moved == targets, lag * velocity, 0), targets[..., -1, :]

    @cached_property
    def _limits(self) -> tuple[tuple[float, ...], ...]:
        found = [(one.low, one.high, one.speed, one.damping / one.gain) for one in self.drives]
        return tuple(zip(*found, strict=True))
