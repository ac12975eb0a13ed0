"""A robot as arrays, read once from an MJCF or URDF file.

All frames are those of the base and of links. A link is what one joint moves; its frame has its origin on
the joint, and at the model's zero posture the base's axes, whatever the file says: so a pose is composed of
offsets and rotations about axes, and nothing else.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.modules import Jittable
from doojax.robots.urdf import JointLimits, urdf_limits
from doojax.types import Obstacles, ShapeKind

if TYPE_CHECKING:
    import mujoco

DUAL_ARM = Path(__file__).with_name("dual_arm.xml")
"""The dual arm of the thesis's chapter 5: a torso of 2 joints, arms of 7 with tools `left` and `right`."""

BASE = -1  # the link that does not move


class Robot(Jittable):
    """J joints in a tree, parents first; radians for hinges, metres for slides."""

    joints: tuple[str, ...] = eqx.field(static=True)
    parents: tuple[int, ...] = eqx.field(static=True)  # the link that each joint sits on, `BASE` for the base
    slides: tuple[bool, ...] = eqx.field(static=True)
    tools: tuple[str, ...] = eqx.field(static=True)
    tool_links: tuple[int, ...] = eqx.field(static=True)
    capsule_links: tuple[int, ...] = eqx.field(static=True)
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)  # of capsules that must not touch
    offset: Float[Array, "J 3"]  # of each joint in its parent's frame, m
    axis: Float[Array, "J 3"]  # unit
    zero: Float[Array, "J"]  # coordinates of the zero posture
    low: Float[Array, "J"]  # limits; infinite where there are none
    high: Float[Array, "J"]
    speed: Float[
        Array, "J"
    ]  # largest, rad/s or m/s, as velocity controllers or a URDF file say; else infinite
    tool_position: Float[Array, "T 3"]  # in the frame of the tool's link, m
    tool_quaternion: Float[Array, "T 4"]
    capsule_ends: Float[Array, "2 S 3"]  # in the frames of their links, m
    capsule_radius: Float[Array, "S"]
    base: Obstacles  # what of the robot does not move

    def tool(self, name: str) -> int:
        """Index of a tool.

        Raises:
            ValueError: for a name that the robot lacks.
        """
        if name not in self.tools:
            raise ValueError(f"unknown tool {name!r}, expected one of {', '.join(self.tools)}")
        return self.tools.index(name)

    def beyond_limits(self, joints: Float[Array, "J"]) -> int | None:
        """The first joint that is beyond its limits by more than rounding; outside of jit."""
        (beyond,) = np.nonzero(np.asarray((joints < self.low - 1e-5) | (joints > self.high + 1e-5)))
        return int(beyond[0]) if beyond.size else None

    def chain(self, link: int) -> tuple[int, ...]:
        """The joints that move a link, from the base on."""
        found: list[int] = []
        while link != BASE:
            found.insert(0, link)
            link = self.parents[link]
        return tuple(found)


def dual_arm() -> Robot:
    """The thesis's dual arm, see `DUAL_ARM`."""
    return read_robot(DUAL_ARM, ("left", "right"))


def read_robot(source: "Path | mujoco.MjModel", tools: tuple[str, ...] | None = None) -> Robot:
    """A robot of a file or of a model that is compiled already; on the host, once.

    Shapes that can collide become capsules: of a box, cylinder, ellipsoid or mesh the smallest around its
    bounding box along the longest side, so that the robot is never thinner than it is. On the base, boxes,
    capsules and cylinders stay what they are. Capsules of one link, of neighbours, of fingers of one hand,
    and such as touch in the zero posture are no pairs.

    Args:
        source: an MJCF or URDF file with a fixed base, or its model.
        tools: names of the sites, or bodies, that are the tools' frames; by default all sites that have
            names, or where there are none the bodies that carry no other.

    Raises:
        ValueError: for a tool that the model lacks, or joints that are neither hinges nor slides; what
            MuJoCo says of a file it cannot read.
    """
    import mujoco  # on first use: robots are arrays, and most of their users need no simulator

    model = _compiled(source) if isinstance(source, Path) else source
    urdf = (urdf_limits(source) if isinstance(source, Path) else None) or {}
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names = tuple(model.joint(j).name or f"joint{j}" for j in range(model.njnt))
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    for name, kind in zip(names, model.jnt_type, strict=True):
        if kind not in (hinge, slide):
            raise ValueError(f"joint {name!r} is neither a hinge nor a slide: a robot's base must be fixed")

    links = _links(model)
    at = np.concatenate([data.xanchor, np.zeros((1, 3))])  # the last, [BASE], is the base's
    parents = tuple(
        j - 1 if model.jnt_bodyid[j - 1] == body and j else links[model.body_parentid[body]]
        for j, body in enumerate(model.jnt_bodyid)
    )
    limited = model.jnt_limited.astype(bool)
    tools = _likely_tools(model) if tools is None else tuple(tools)
    places = [_place(model, data, name, links) for name in tools]
    capsules, base = _shapes(model, data, links)
    ends = np.array([ends - at[link] for link, ends, _ in capsules]).reshape(-1, 2, 3).swapaxes(0, 1)
    array = jnp.asarray
    robot = Robot(
        joints=names,
        parents=parents,
        slides=tuple(bool(kind == slide) for kind in model.jnt_type),
        tools=tools,
        tool_links=tuple(link for link, _, _ in places),
        capsule_links=tuple(link for link, _, _ in capsules),
        pairs=(),
        offset=array(at[:-1] - at[list(parents)], float).reshape(-1, 3),
        axis=array(data.xaxis, float),
        zero=array(model.qpos0, float),
        low=array(np.where(limited, model.jnt_range[:, 0], -np.inf), float),
        high=array(np.where(limited, model.jnt_range[:, 1], np.inf), float),
        speed=array(_speeds(model, urdf), float),
        tool_position=array([place - at[link] for link, place, _ in places], float).reshape(-1, 3),
        tool_quaternion=array([turn for _, _, turn in places], float).reshape(-1, 4),
        capsule_ends=array(ends, float),
        capsule_radius=array([radius for _, _, radius in capsules], float),
        base=base,
    )
    return replace(robot, pairs=_pairs(robot))


def _links(model: "mujoco.MjModel") -> list[int]:
    """Which link each body belongs to: the last joint on its way from the world."""
    links = [BASE]
    for body in range(1, model.nbody):
        count = model.body_jntnum[body]
        links.append(int(model.body_jntadr[body] + count - 1) if count else links[model.body_parentid[body]])
    return links


def _likely_tools(model: "mujoco.MjModel") -> tuple[str, ...]:
    sites = tuple(filter(None, (model.site(i).name for i in range(model.nsite))))
    carrying = set(model.body_parentid.tolist())
    ends = (model.body(i).name for i in range(1, model.nbody) if i not in carrying)
    return sites or tuple(filter(None, ends))


def _place(model: "mujoco.MjModel", data: "mujoco.MjData", name: str, links: list[int]) -> tuple:
    """Link, position and quaternion in the zero posture of a site, or of a body."""
    import mujoco

    turn = np.zeros(4)
    sites = [model.site(i).name for i in range(model.nsite)]
    if name in sites:
        site = data.site(name)
        mujoco.mju_mat2Quat(turn, site.xmat)
        return links[model.site_bodyid[site.id]], site.xpos, turn
    bodies = [model.body(i).name for i in range(model.nbody)]
    if name in bodies:
        body = data.body(name)
        return links[body.id], body.xpos, body.xquat
    raise ValueError(
        f"the robot has no tool {name!r}: expected one of its sites ({', '.join(filter(None, sites))}) "
        f"or bodies ({', '.join(filter(None, bodies))})"
    )


def _compiled(source: Path) -> "mujoco.MjModel":
    """The model of a file; links of a URDF file that do not move, such as tools, stay what they are."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(source))
    spec.compiler.fusestatic = False
    return spec.compile()


def _speeds(model: "mujoco.MjModel", urdf: dict[str, JointLimits]) -> np.ndarray:
    import mujoco

    names = [model.joint(joint).name for joint in range(model.njnt)]
    speeds = np.array([urdf[name].speed if name in urdf else np.inf for name in names])
    for actuator in range(model.nu):
        velocity = model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_INTEGRATOR
        of_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        if velocity and of_joint and model.actuator_ctrllimited[actuator]:
            speeds[model.actuator_trnid[actuator, 0]] = np.abs(model.actuator_ctrlrange[actuator]).min()
    return speeds


def _shapes(model: "mujoco.MjModel", data: "mujoco.MjData", links: list[int]) -> tuple[list, Obstacles]:
    """Capsules (link, ends, radius) that move and shapes that do not, in the zero posture."""
    import mujoco

    kinds = {
        int(mujoco.mjtGeom.mjGEOM_BOX): ShapeKind.BOX,
        int(mujoco.mjtGeom.mjGEOM_CAPSULE): ShapeKind.CAPSULE,
        int(mujoco.mjtGeom.mjGEOM_CYLINDER): ShapeKind.CYLINDER,
    }
    capsules, fixed = [], []
    for geom in range(model.ngeom):
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        if kind == mujoco.mjtGeom.mjGEOM_PLANE or not (
            model.geom_contype[geom] or model.geom_conaffinity[geom]
        ):
            continue
        turn = data.geom_xmat[geom].reshape(3, 3)
        centre = data.geom_xpos[geom] + turn @ model.geom_aabb[geom, :3]
        half = model.geom_aabb[geom, 3:]
        link = links[model.geom_bodyid[geom]]
        if link == BASE:
            quaternion = np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, turn.ravel())
            shape = kinds.get(kind, ShapeKind.BOX)
            fixed.append((shape, centre, quaternion, half if shape == ShapeKind.BOX else size[[0, 0, 1]]))
            continue
        if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE):
            along = turn[:, 2] * (size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0)
            radius = size[0]
        else:
            longest = int(np.argmax(half))
            along, radius = turn[:, longest] * half[longest], np.hypot(*np.delete(half, longest))
        capsules.append((link, np.array([centre - along, centre + along]), radius))
    shape, centre, quaternion, size = zip(*fixed, strict=True) if fixed else ((), (), (), ())
    base = Obstacles(
        kind=jnp.asarray(shape, int),
        centre=jnp.asarray(centre, float).reshape(-1, 3),
        quaternion=jnp.asarray(quaternion, float).reshape(-1, 4),
        half_size=jnp.asarray(size, float).reshape(-1, 3),
        active=jnp.ones(len(fixed), bool),
    )
    return capsules, base


def _pairs(robot: Robot) -> tuple[tuple[int, int], ...]:
    from doojax.robots.clearance import capsule_distances  # which needs robots

    def joined(a: int, b: int) -> bool:
        fingers = robot.parents[a] == robot.parents[b] and not {a, b} & set(robot.parents)
        return a == b or robot.parents[a] == b or robot.parents[b] == a or fingers

    links = robot.capsule_links
    pairs = [
        (i, j) for i in range(len(links)) for j in range(i + 1, len(links)) if not joined(links[i], links[j])
    ]
    at_zero = jax.jit(lambda robot: capsule_distances(robot, robot.zero, pairs))  # compiles as one
    apart = np.asarray(at_zero(robot)) > 0
    return tuple(pair for pair, free in zip(pairs, apart, strict=True) if free)
