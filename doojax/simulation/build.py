"""From a `Scene` to the MuJoCo model that every engine runs."""

from dataclasses import replace

import mujoco
import numpy as np

from doojax.simulation.rope import RopeParameters
from doojax.simulation.scenes import Scene

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
    all that `doojax.simulation.layout.read_frames` gives.
    """
    scene = _with_rope(scene, rope)
    spec = build_spec(scene)
    if with_sensors:
        _add_sensors(spec, scene)
    model = spec.compile()
    if scene.rope is not None:
        scene.rope_part.finish(model)
    return model


def build_spec(scene: Scene, rope: RopeParameters | None = None) -> mujoco.MjSpec:
    """The editable MJCF of ``scene``; see `build_model`."""
    scene = _with_rope(scene, rope)
    spec = mujoco.MjSpec()
    spec.modelname = scene.name
    _set_options(spec, scene)
    for part in scene.parts:
        part.add(spec, scene)
    for geom in spec.geoms:
        geom.solref, geom.solimp = [scene.solver.contact_time, 1], list(CONTACT_IMPEDANCE)
        geom.friction = [max(geom.friction[0], LEAST_FRICTION), 0, 0]
    for equality in spec.equalities:
        equality.solref, equality.solimp = [scene.solver.contact_time, 1], list(HOLD_IMPEDANCE)
    return spec


def _with_rope(scene: Scene, rope: RopeParameters | None) -> Scene:
    return scene if rope is None else replace(scene, rope=rope)


def _add_sensors(spec: mujoco.MjSpec, scene: Scene) -> None:
    """All parts' frames, in world coordinates, in the parts' order."""
    kinds, objects = mujoco.mjtSensor, mujoco.mjtObj
    ways = {
        "body": (kinds.mjSENS_FRAMEPOS, objects.mjOBJ_XBODY),
        "axis": (kinds.mjSENS_FRAMEXAXIS, objects.mjOBJ_XBODY),
        "site": (kinds.mjSENS_FRAMEPOS, objects.mjOBJ_SITE),
    }
    for frames in (one for part in scene.parts for one in part.frames()):
        kind, of = ways[frames.kind]
        for name in frames.names:
            spec.add_sensor(type=kind, objtype=of, objname=name)


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


def with_parameters(scene: Scene, ropes: list[RopeParameters]) -> dict[str, np.ndarray]:
    """Stack the variable model fields of ``scene`` for each of ``ropes``: one leading axis, same shapes."""
    fields = [variable_fields(build_model(scene, rope)) for rope in ropes]
    return {name: np.stack([f[name] for f in fields]) for name in VARIABLE_FIELDS}
