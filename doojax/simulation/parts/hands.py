"""Free hands: spheres on slides that follow targets with a bounded force, and hold a rope or nothing."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from doojax.simulation.parts.base import Frames, Part, Places, Turn, find_frames, put
from doojax.simulation.rope import FLOOR_CONTACT, OBSTACLE_CONTACT, link_name

if TYPE_CHECKING:
    from doojax.simulation.layout import Observation
    from doojax.simulation.scenes import Gripper, Scene


@dataclass(frozen=True)
class Hands(Part):
    """Hands in space, or in a horizontal plane at the height of what they handle."""

    grippers: tuple["Gripper", ...]
    planar: bool

    @property
    def axes(self) -> str:
        """Along which they move."""
        return "xy" if self.planar else "xyz"

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the hands' bodies."""
        return tuple(hand_name(index) for index in range(len(self.grippers)))

    @property
    def anchors(self) -> tuple[tuple[float, float, float], ...]:
        """Where on those they hold, m."""
        return ((0.0, 0.0, 0.0),) * len(self.grippers)

    def add(self, spec: mujoco.MjSpec, scene: "Scene") -> None:
        """Add a body, its slides and position controllers, and the switchable hold on the rope, for each."""
        for index, gripper in enumerate(self.grippers):
            self._add_hand(spec, scene, gripper, index)
            if gripper.link is not None:
                add_hold(spec, scene, gripper, index)

    def _add_hand(self, spec: mujoco.MjSpec, scene: "Scene", gripper: "Gripper", index: int) -> None:
        name = hand_name(index)
        body = spec.worldbody.add_body(name=name, pos=[0, 0, scene.plane_height if self.planar else 0])
        # the hand's inertia is that of the arm's drives, which carry its weight: inertia without weight
        body.mass, body.ipos, body.explicitinertial = 1e-3, [0, 0, 0], True
        body.inertia = [0.4e-3 * gripper.radius**2] * 3
        directions = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}
        damping = 2 * (gripper.stiffness * gripper.inertia) ** 0.5
        for axis in self.axes:
            joint = body.add_joint(
                name=f"{name}_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=directions[axis]
            )
            joint.armature = gripper.inertia
            actuator = spec.add_actuator(
                name=joint.name,
                target=joint.name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                forcelimited=True,
                forcerange=[-gripper.max_force, gripper.max_force],
            )
            actuator.set_to_position(kp=gripper.stiffness, kv=damping)
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[gripper.radius, 0, 0],
            contype=0,
            conaffinity=OBSTACLE_CONTACT | (0 if self.planar else FLOOR_CONTACT),
            friction=[scene.friction, 0, 0],
            condim=3,
        )
        body.add_site(name=name)

    def frames(self) -> tuple[Frames, ...]:
        """The hands, and the points that they hold."""
        names = [(hand_name(g), gripper.link is not None) for g, gripper in enumerate(self.grippers)]
        holds = tuple(hold_name(name) for name, holds in names if holds)
        return Frames("body", tuple(name for name, _ in names)), Frames("site", holds)

    def find(self, model: mujoco.MjModel) -> Places:
        """``qpos`` are the world coordinates, [G, D]; D is 2 in a plane."""
        joints = [[model.joint(f"{hand_name(g)}_{a}") for a in self.axes] for g in range(len(self.grippers))]
        shape = (len(self.grippers), len(self.axes))
        holding = [g for g, gripper in enumerate(self.grippers) if gripper.link is not None]
        return Places(
            frames=find_frames(model, self.frames()),
            qpos=np.array([[one.qposadr[0] for one in row] for row in joints], dtype=int).reshape(shape),
            dofs=np.array([[one.dofadr[0] for one in row] for row in joints], dtype=int).reshape(shape),
            holds=np.array([model.equality(hand_name(g)).id for g in holding], dtype=int),
        )

    def see(
        self,
        vectors: list[Float[Array, "*b _ 3"]],
        coordinates: Float[Array, "*b C"],
        sizes: Float[Array, "*b Z 2"],
    ) -> dict[str, Array]:
        """Positions, and those of the points held."""
        return {"grippers": vectors[0], "hold_points": vectors[1]}

    def samples(self, seen: "Observation") -> list[tuple[Float[Array, "P 3"], Float[Array, "P"]]]:
        """The centres."""
        radii = jnp.array([gripper.radius for gripper in self.grippers], dtype=seen.hands.dtype)
        return [(seen.hands, radii)]

    def moved(self, places: Places, qpos: Array, qvel: Array, turn: Turn) -> tuple[Array, Array]:
        """Coordinates are places in the world."""
        return (
            put(qpos, places.qpos, turn.points(qpos[places.qpos])),
            put(qvel, places.dofs, turn.vectors(qvel[places.dofs])),
        )

    def moved_command(self, commanded: Array, turn: Turn) -> Array:
        """Where the hands were last sent, moved."""
        return turn.points(commanded)

    def drive(self, scene: "Scene", at: Any, commanded: Any, action: Any, xp: Any = jnp) -> tuple[Any, Any]:
        """Controls of the actuators at each of S physics steps of a period, and what is then commanded.

        Args:
            scene: whose period it is.
            at: ``[*b, G, D]``, coordinates at the places' ``qpos``, m.
            commanded: ``[*b, G, D]``, where the hands were last sent, m.
            action: ``[*b, G, 3]``, displacements, m.
            xp: jax.numpy or numpy.

        Returns:
            ``[*b, S, U]`` for U actuators, and ``[*b, G, D]``.
        """
        targets = gripper_targets(scene, at, commanded, action[..., : at.shape[-1]], xp)
        return targets.reshape(*targets.shape[:-2], -1), targets[..., -1, :, :]


def hand_name(index: int) -> str:
    """Name of a hand's body, geom, site and hold."""
    return f"gripper{index}"


def hold_name(hand: str) -> str:
    """Name of the site on the rope that a hand holds."""
    return f"{hand}_hold"


def add_hold(spec: mujoco.MjSpec, scene: "Scene", gripper: "Gripper", index: int) -> None:
    """Let the site ``gripper<index>`` hold a link of the rope, by an equality that data switch on and off."""
    name, rope = hand_name(index), scene.rope_part
    if gripper.link is None:
        raise ValueError(f"gripper {index} holds no link: expected one")
    pitch = rope.parameters.length / rope.model.links
    end = 0.0 if rope.model.kind == "point_masses" else gripper.end * pitch / 2
    spec.body(link_name(gripper.link)).add_site(name=hold_name(name), pos=[end, 0, 0])
    kind = mujoco.mjtEq.mjEQ_CONNECT if gripper.hold == "point" else mujoco.mjtEq.mjEQ_WELD
    equality = spec.add_equality(
        name=name,
        type=kind,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
    )
    equality.name1, equality.name2 = hold_name(name), name
    if gripper.hold == "rigid":
        data = np.array(equality.data)
        data[10] = 10.0  # torque scale: at 1 a clamped stiff rope visibly turns in its clamp
        equality.data = data


def gripper_targets(scene: "Scene", hand: Any, commanded: Any, action: Any, xp: Any = jnp) -> Any:
    """Where each gripper is sent at each of S physics steps of a control period, ``[*b, S, G, D]``, metres.

    The target moves by the action, in a straight line at the gripper's maximum speed, and then stays. It sets
    out from where the gripper was last sent, so that a load that keeps the hand from getting there quite does
    not make it sink from action to action; but it leads the hand, along each axis, by no more than the
    controller's greatest force needs: a hand held back by an obstacle turns round at once.

    Args:
        scene: whose grippers.
        hand: ``[*b, G, D]``, where the grippers are, m.
        commanded: ``[*b, G, D]``, where they were last sent, m.
        action: ``[*b, G, D]``, displacements, m.
        xp: jax.numpy or numpy.
    """
    lead = xp.array([[gripper.lead] for gripper in scene.grippers], dtype=hand.dtype)
    start = xp.clip(commanded, hand - lead, hand + lead)
    square = (action**2).sum(-1)
    short = square < 1e-18  # m^2; at zero the square root has no derivative
    distance = xp.where(short, 1e-9, xp.where(short, 1.0, square) ** 0.5)
    speed = xp.array([gripper.max_speed for gripper in scene.grippers], dtype=hand.dtype)
    elapsed = xp.arange(1, scene.substeps + 1, dtype=hand.dtype) * scene.timestep
    fraction = xp.minimum(elapsed[:, None] * (speed / distance)[..., None, :], 1.0)
    return start[..., None, :, :] + fraction[..., None] * action[..., None, :, :]
