"""From a `Scene` to the MuJoCo model that every engine runs."""

import mujoco
import numpy as np

from doojax.simulation.rope import (
    FLOOR_CONTACT,
    OBSTACLE_CONTACT,
    RopeParameters,
    add_floor_friction,
    add_rope,
    link_name,
    stabilise_root,
)
from doojax.simulation.scenes import PARKED_POSITION, PARKED_QUATERNION, Gripper, Obstacle, Scene, Shape
from doojax.types import ShapeKind

# The fields of a model that rope parameters reach; everything else is shared by a batch.
VARIABLE_FIELDS = (
    "body_pos",
    "body_ipos",
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_invweight0",
    "geom_size",
    "geom_rbound",
    "geom_friction",
    "geom_pos",
    "site_pos",
    "jnt_pos",
    "jnt_stiffness",
    "dof_armature",
    "dof_damping",
    "dof_invweight0",
    "tendon_stiffness",
    "tendon_armature",
    "tendon_damping",
    "tendon_frictionloss",
    "tendon_lengthspring",
    "tendon_length0",
    "tendon_invweight0",
)

LEAST_FRICTION = 1e-5  # MuJoCo's own; warp wants it said
HOLD_IMPEDANCE = (0.999, 0.9999, 0.001, 0.5, 2.0)
FRICTION_OVER_NORMAL = 3.0  # how much harder friction is than a contact: at 1 a held rope creeps
CONTACT_IMPEDANCE = (0.95, 0.99, 0.001, 0.5, 2.0)


def build_model(
    scene: Scene, rope: RopeParameters | None = None, *, with_sensors: bool = False
) -> mujoco.MjModel:
    """Compile ``scene``, with other rope parameters than its own if ``rope`` is given.

    Models of one scene differ in values only, never in shapes. Obstacles start parked. ``with_sensors``: of
    all that `doojax.simulation.layout.read_sensors` reads.
    """
    spec = build_spec(scene, rope)
    if with_sensors:
        _add_sensors(spec, scene)
    model = spec.compile()
    stabilise_root(model)
    return model


def build_spec(scene: Scene, rope: RopeParameters | None = None) -> mujoco.MjSpec:
    """The editable MJCF of ``scene``; see `build_model`."""
    rope = scene.rope if rope is None else rope
    spec = mujoco.MjSpec()
    spec.modelname = scene.name
    _set_options(spec, scene)
    if scene.floor and not scene.planar:
        spec.worldbody.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[5, 5, 0.1],
            contype=FLOOR_CONTACT,
            conaffinity=0,
            friction=[0, 0, 0],  # the rope's own counts
        )
    for obstacle in scene.obstacles:
        _add_obstacle(spec, scene, obstacle)
    add_rope(spec, scene.rope_model, rope, height=rope.radius, clamped=_clamped(scene))
    if scene.floor and scene.planar:
        add_floor_friction(spec, scene.rope_model, rope, scene.gravity, scene.solver.contact_time)
    for index, gripper in enumerate(scene.grippers):
        _add_gripper(spec, scene, rope, gripper, index)
    for geom in spec.geoms:
        geom.solref, geom.solimp = [scene.solver.contact_time, 1], list(CONTACT_IMPEDANCE)
        geom.friction = [max(geom.friction[0], LEAST_FRICTION), 0, 0]
    for equality in spec.equalities:
        equality.solref, equality.solimp = [scene.solver.contact_time, 1], list(HOLD_IMPEDANCE)
    return spec


def _add_sensors(spec: mujoco.MjSpec, scene: Scene) -> None:
    """Links' centres, their axes, grippers and the points they hold, in world coordinates, in this order."""
    kinds = mujoco.mjtSensor
    bodies, sites = mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_SITE
    links = [link_name(index) for index in range(scene.rope_model.links)]
    grippers = [f"gripper{index}" for index in range(len(scene.grippers))]
    for kind, frame, names in (
        (kinds.mjSENS_FRAMEPOS, bodies, links),
        (kinds.mjSENS_FRAMEXAXIS, bodies, links),
        (kinds.mjSENS_FRAMEPOS, bodies, grippers),
        (kinds.mjSENS_FRAMEPOS, sites, [f"{name}_hold" for name in grippers]),
    ):
        for name in names:
            spec.add_sensor(type=kind, objtype=frame, objname=name)


def variable_fields(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """The values of `VARIABLE_FIELDS` in ``model``."""
    return {name: np.array(getattr(model, name)) for name in VARIABLE_FIELDS}


def _set_options(spec: mujoco.MjSpec, scene: Scene) -> None:
    option, solver = spec.option, scene.solver
    option.timestep = scene.timestep
    option.gravity = [0, 0, -scene.gravity]
    option.viscosity = scene.viscosity
    integrators = {"euler": mujoco.mjtIntegrator.mjINT_EULER, "rk4": mujoco.mjtIntegrator.mjINT_RK4}
    option.integrator = integrators[scene.integrator]
    # explicit damping: constraint forces are solved for in the same inertia that they act on, and one
    # factorisation a step is saved; doojax.simulation.rope keeps its joints stable
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    algorithms = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}
    option.solver = algorithms[solver.algorithm]
    cones = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}
    option.cone = cones[solver.cone]
    if solver.cone == "elliptic":
        option.impratio = FRICTION_OVER_NORMAL
    option.iterations, option.tolerance = solver.iterations, solver.tolerance
    option.ls_iterations = solver.line_search_iterations
    # a state that blows up must stay visible: MuJoCo would put the rope back to its start
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.add_numeric(name="max_contact_points", data=[solver.max_contact_points])


def _add_obstacle(spec: mujoco.MjSpec, scene: Scene, obstacle: Obstacle) -> None:
    body = spec.worldbody.add_body(
        name=obstacle.name, mocap=True, pos=list(PARKED_POSITION), quat=list(PARKED_QUATERNION)
    )
    for index, shape in enumerate(obstacle.shapes):
        kind, size, offset = _geom_of(shape)
        body.add_geom(
            name=f"{obstacle.name}_{index}",
            type=kind,
            size=size,
            pos=offset,
            quat=[0.5**0.5, 0, 0.5**0.5, 0] if shape.wall else [1, 0, 0, 0],  # a plane's normal is +z
            contype=OBSTACLE_CONTACT,
            conaffinity=0,
            friction=[obstacle.friction, 0, 0],
        )


def _geom_of(shape: Shape) -> tuple[mujoco.mjtGeom, list[float], list[float]]:
    x, y, z = shape.half_size
    if shape.wall:
        face = [shape.offset[0] + x, shape.offset[1], shape.offset[2]]
        return mujoco.mjtGeom.mjGEOM_PLANE, [z, y, 0.1], face
    kinds = {
        ShapeKind.BOX: (mujoco.mjtGeom.mjGEOM_BOX, [x, y, z]),
        ShapeKind.CAPSULE: (mujoco.mjtGeom.mjGEOM_CAPSULE, [x, z, 0.0]),
        ShapeKind.CYLINDER: (mujoco.mjtGeom.mjGEOM_CYLINDER, [x, z, 0.0]),
    }
    kind, size = kinds[shape.kind]
    return kind, size, list(shape.offset)


def _clamped(scene: Scene) -> tuple[bool, bool]:
    """Does a rigid hold clamp the rope's first end, and its last?"""
    last = scene.rope_model.links - 1
    rigid = {(gripper.link, gripper.end) for gripper in scene.grippers if gripper.hold == "rigid"}
    return (0, -1) in rigid, (last, 1) in rigid


def _add_gripper(
    spec: mujoco.MjSpec, scene: Scene, rope: RopeParameters, gripper: Gripper, index: int
) -> None:
    """A sphere on slides whose coordinates are its world position, and the switchable hold on the rope."""
    name = f"gripper{index}"
    body = spec.worldbody.add_body(name=name, pos=[0, 0, rope.radius if scene.planar else 0])
    # the hand's inertia is that of the arm's drives, which carry its weight: inertia without weight
    body.mass, body.ipos, body.explicitinertial = 1e-3, [0, 0, 0], True
    body.inertia = [0.4e-3 * gripper.radius**2] * 3
    axes = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}
    if scene.planar:
        del axes["z"]
    damping = 2 * (gripper.stiffness * gripper.inertia) ** 0.5
    for axis, direction in axes.items():
        joint = body.add_joint(name=f"{name}_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
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
        conaffinity=OBSTACLE_CONTACT | (0 if scene.planar else FLOOR_CONTACT),
        friction=[rope.friction, 0, 0],
        condim=3,
    )
    body.add_site(name=name)
    pitch = rope.length / scene.rope_model.links
    end = 0.0 if scene.rope_model.kind == "point_masses" else gripper.end * pitch / 2
    held = spec.body(link_name(gripper.link))
    held.add_site(name=f"{name}_hold", pos=[end, 0, 0])
    kind = mujoco.mjtEq.mjEQ_CONNECT if gripper.hold == "point" else mujoco.mjtEq.mjEQ_WELD
    equality = spec.add_equality(
        name=name,
        type=kind,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
    )
    equality.name1, equality.name2 = f"{name}_hold", name
    if gripper.hold == "rigid":
        data = np.array(equality.data)
        data[10] = 10.0  # torque scale: at 1 a clamped stiff rope visibly turns in its clamp
        equality.data = data


def with_parameters(scene: Scene, ropes: list[RopeParameters]) -> dict[str, np.ndarray]:
    """Stack the variable model fields of ``scene`` for each of ``ropes``: one leading axis, same shapes."""
    fields = [variable_fields(build_model(scene, rope)) for rope in ropes]
    return {name: np.stack([f[name] for f in fields]) for name in VARIABLE_FIELDS}
