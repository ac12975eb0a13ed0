"""Ropes as MuJoCo bodies: capsule chains, planar capsule chains and point masses.

A rope's parameters are SI quantities of the continuum (EI, GJ, total mass, ...); the joints and tendons that
carry them are derived from the number of links, so refining a rope does not change it: N links have N - 1
joints, which bend for the rope from the middle of the first link to the middle of the last. Where a rigid
hold clamps an outer end, the joint beside it bends for the half link up to the clamp, too. Stiffness lives in
joints and tendons and never in MuJoCo's elasticity plugins, which MJX ignores without a word.
"""

import cmath
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import mujoco

RopeKind = Literal["capsule_chain", "planar_chain", "point_masses"]

ROPE_CONTACT, OBSTACLE_CONTACT, FLOOR_CONTACT = 1, 2, 4  # collision bits
ROOT = "rope_root"  # name of a rope's free joint
FRICTION_DIRECTIONS = 4  # in which a planar rope's link rubs on the floor
MODE_ERROR = 0.03  # of the first bending mode, that a time step may cause
FAR = 100.0  # m to where the lines lie that those directions point at: they turn by less than a degree


@dataclass(frozen=True)
class RopeParameters:
    """What a rope is made of; may differ from one batch element to the next without a new compile.

    Raises ValueError when a value is negative, or zero where that has no meaning.
    """

    length: float  # m, end to end
    radius: float  # m
    mass: float  # kg, the whole rope
    bending_stiffness: float  # EI, N m^2
    twisting_stiffness: float = 0.0  # GJ, N m^2; only a capsule chain twists
    bending_damping: float = 0.0  # moment per rate of curvature, N m^2 s; also resists twisting
    friction: float = 0.1  # Coulomb coefficient against floor and obstacles

    def __post_init__(self):
        """Refuse values without a physical meaning."""
        for name, value in vars(self).items():
            positive = name in ("length", "radius", "mass")
            if not (value > 0 if positive else value >= 0):
                raise ValueError(f"rope {name} is {value}, expected {'> 0' if positive else '>= 0'}")

    @classmethod
    def of_material(
        cls,
        *,
        length: float,
        radius: float,
        mass: float,
        youngs_modulus: float,
        bore: float = 0.0,
        poisson: float = 0.5,
        bending_damping: float = 0.0,
        friction: float = 0.1,
    ) -> "RopeParameters":
        """A round rod or hose of one elastic material, as data sheets describe it.

        EI = E pi (radius^4 - bore^4) / 4 and GJ = EI / (1 + poisson), as of a solid of revolution. What is
        braided, filled or reinforced bends otherwise: measure its EI, and give that.

        Args:
            length: end to end, m.
            radius: outer, m.
            mass: of the whole, with what fills it, kg.
            youngs_modulus: E, Pa; of rubber 1e6 to 1e7.
            bore: inner radius of a hose, m.
            poisson: Poisson's ratio of the material; a half for rubber.
            bending_damping: moment per rate of curvature, N m^2 s; data sheets do not have it, and where a
                rope needs some to be stable the error says how much.
            friction: Coulomb's coefficient against floor and obstacles.

        Raises:
            ValueError: for values without a physical meaning.
        """
        if not 0 <= bore < radius:
            raise ValueError(f"rope bore is {bore}, expected at least 0 and less than the radius of {radius}")
        if not youngs_modulus >= 0 or not -1 < poisson <= 0.5:
            raise ValueError(
                f"youngs_modulus is {youngs_modulus} and poisson {poisson}, expected at least 0 (Pa), and "
                "more than -1 and at most 0.5"
            )
        bending = youngs_modulus * math.pi * (radius**4 - bore**4) / 4
        return cls(length, radius, mass, bending, bending / (1 + poisson), bending_damping, friction)


@dataclass(frozen=True)
class RopeModel:
    """How a rope is cut into bodies; part of the compiled model."""

    kind: RopeKind
    links: int
    self_contact: bool = False

    def __post_init__(self):
        """Refuse ropes too short to bend."""
        if self.links < 3:
            raise ValueError(f"a rope needs at least 3 links, got {self.links}")
        if self.kind == "planar_chain" and self.self_contact:
            raise ValueError("self-contact needs kind='capsule_chain'; a planar chain has none")


def link_name(index: int) -> str:
    """Name of the body of rope link ``index``."""
    return f"rope{index}"


def first_mode_error(rope: RopeParameters, timestep: float) -> float:
    """By what fraction a ``timestep`` (s) misplaces the first bending mode of a rope clamped at one end.

    The mode obeys x'' + t w^2 x' + w^2 x = 0 with w = 1.8751^2 sqrt(EI / (m / L)) / L^2 (Euler and Bernoulli)
    and t = damping / EI. The simulation adds the joints' stabilising inertia and steps by Euler's method.
    Compared is the eigenvalue that decays most slowly: a frequency, or the rate at which a rope that is
    damped beyond it creeps.
    """
    if rope.bending_stiffness == 0:
        return 0.0
    square = 1.8751**4 * rope.bending_stiffness * rope.length / rope.mass / rope.length**4
    retarded = rope.bending_damping / rope.bending_stiffness * square
    inertia = 1 + _stabilising_inertia(square, retarded, timestep)
    true = _slowest(retarded, square)
    # one step: v' = v - dt (retarded v + square x) / inertia, x' = x + dt v'
    v_by_v, v_by_x = 1 - timestep * retarded / inertia, -timestep * square / inertia
    half_trace = (v_by_v + 1 + timestep * v_by_x) / 2
    factor = half_trace + cmath.sqrt(half_trace**2 - v_by_v)
    return abs(cmath.log(factor) / timestep - true) / abs(true)


def _slowest(damping: float, square: float) -> complex:
    """The root of s^2 + damping s + square = 0 with the greatest real part (then imaginary part)."""
    half, root = damping / 2, cmath.sqrt(damping**2 / 4 - square)
    # the other root first: the difference of nearly equal numbers has no digits
    return -half + root if root.imag else -square / (half + root)


def add_rope(
    spec: "mujoco.MjSpec",
    model: RopeModel,
    rope: RopeParameters,
    height: float,
    clamped: tuple[bool, bool] = (False, False),
) -> None:
    """Add a straight rope along x, centred at x = y = 0 and at ``height``, to ``spec``.

    Link i's centre lies at x = (i + 1/2) length / links - length / 2. Chains are rooted at their middle link:
    compile and run time in MJX grow with the depth of the tree. ``clamped``: are its first and last end?

    Raises:
        ValueError: for a rope too stiff for the spec's time step, one that is damped too little for Euler's
            method, or a stiff rope of point masses.
    """
    if model.kind == "point_masses":
        if rope.bending_stiffness or rope.twisting_stiffness or rope.bending_damping:
            raise ValueError(
                "a rope of point masses is limp: bending_stiffness, twisting_stiffness and bending_damping "
                f"must be 0, got {rope.bending_stiffness}, {rope.twisting_stiffness} and "
                f"{rope.bending_damping}; use kind='capsule_chain' for a rope that resists bending"
            )
        _add_point_masses(spec, model, rope, height)
    else:
        _add_chain(spec, model, rope, height, clamped)


def _require_calm_links(model: RopeModel, rope: RopeParameters, timestep: float) -> None:
    """Refuse ropes whose links would spin up about their axes, which steps of Euler's method do not see."""
    link_mass, pitch = rope.mass / model.links, rope.length / model.links
    least = link_mass * rope.radius**2 * pitch / timestep  # a link's spin then dies within half a step
    if rope.bending_damping < least:
        raise ValueError(
            f"rope bending_damping is {rope.bending_damping:g} N m^2 s, expected at least {least:.2g} for "
            f"{model.links} links and a timestep of {timestep:g} s: less, and the rope gains energy until it "
            'bursts; or use Scene(integrator="rk4"), which takes four times as long'
        )


def _require_small_step(rope: RopeParameters, timestep: float) -> None:
    error = first_mode_error(rope, timestep)
    if error > MODE_ERROR:
        enough = timestep
        while first_mode_error(rope, enough) > MODE_ERROR:
            enough /= 1.1
        raise ValueError(
            f"bending_stiffness {rope.bending_stiffness:g} N m^2 is too much for a timestep of {timestep:g} "
            f"s: the rope's first bending mode would be off by {error:.0%}, expected at most "
            f"{MODE_ERROR:.0%}; use a timestep of at most {enough:.2g} s"
        )


def _add_chain(
    spec: "mujoco.MjSpec", model: RopeModel, rope: RopeParameters, height: float, clamped: tuple[bool, bool]
) -> None:
    import mujoco

    _require_small_step(rope, spec.option.timestep)
    if model.kind == "capsule_chain" and spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        _require_calm_links(model, rope, spec.option.timestep)
    planar = model.kind == "planar_chain"
    pitch, mass = rope.length / model.links, rope.mass / model.links
    middle = model.links // 2
    bodies: dict[int, mujoco.MjsBody] = {}
    for index in sorted(range(model.links), key=lambda i: abs(i - middle)):
        if index == middle:
            x = (middle + 0.5) * pitch - rope.length / 2
            body = spec.worldbody.add_body(name=link_name(index), pos=[x, 0, height])
            _add_root_joints(spec, body, rope, pitch, planar)
        else:
            step = 1 if index > middle else -1
            body = bodies[index - step].add_body(name=link_name(index), pos=[step * pitch, 0, 0])
            held = {0: clamped[0], model.links - 1: clamped[1]}.get(index, False)
            bends_for = 1.5 * pitch if held else pitch
            _add_bending_joints(spec, body, rope, bends_for, anchor=-step * pitch / 2, planar=planar)
        body.mass = mass
        axial, transverse = mass * rope.radius**2 / 2, mass * (pitch**2 / 12 + rope.radius**2 / 4)
        body.inertia = [axial, transverse, transverse]
        body.ipos = [0, 0, 0]
        body.explicitinertial = True
        _add_link_geoms(body, model, rope, pitch)
        bodies[index] = body
    if model.self_contact:
        for i in range(model.links - 2):  # capsules two apart touch at the joint when the rope bends
            spec.add_exclude(bodyname1=link_name(i), bodyname2=link_name(i + 2))


def _add_root_joints(
    spec: "mujoco.MjSpec", body: "mujoco.MjsBody", rope: RopeParameters, pitch: float, planar: bool
) -> None:
    """A free joint whose turns about the link's own axis have the inertia of the twisting joints beside it:
    without, the one link that has none spins up where friction turns it, until the rope bursts.
    `stabilise_root` takes that inertia away again from the joint's other degrees of freedom."""
    import mujoco

    if not planar:
        root = body.add_freejoint(name=ROOT)
        root.armature = _stabilising_inertia(
            rope.twisting_stiffness / pitch, rope.bending_damping / pitch, spec.option.timestep
        )
        return
    for axis, direction in {"x": [1, 0, 0], "y": [0, 1, 0]}.items():
        body.add_joint(name=f"rope_root_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
    body.add_joint(name="rope_root_yaw", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])


def stabilise_root(model: "mujoco.MjModel") -> None:
    """Leave a free root's stabilising inertia to its turns about its axis: MJCF knows one value for all six
    degrees of freedom, and the others move the whole rope."""
    import mujoco

    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, ROOT) < 0:
        return
    first = model.joint(ROOT).dofadr[0]
    model.dof_armature[[first + i for i in range(6) if i != 3]] = 0
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _add_bending_joints(
    spec: "mujoco.MjSpec",
    body: "mujoco.MjsBody",
    rope: RopeParameters,
    pitch: float,
    anchor: float,
    planar: bool,
) -> None:
    """Hinges about z, and for a rope in space about y and x: bending, bending, twisting.

    The integrator is explicit. A joint inertia (armature) of k dt^2 / 2 + c dt keeps a spring k and a damper
    c stable whatever the link's own inertia: k dt^2 / a + 2 c dt / a < 4 bounds the step. It adds the
    fraction (w dt)^2 / 2 + 2 z w dt to the inertia of a mode of angular frequency w and damping ratio z,
    which `first_mode_error` bounds; no static shape depends on it.
    """
    import mujoco

    hinges = [("bend_z", [0, 0, 1], rope.bending_stiffness)]
    if not planar:
        hinges.insert(0, ("bend_y", [0, 1, 0], rope.bending_stiffness))
        hinges.append(("twist", [1, 0, 0], rope.twisting_stiffness))
    for name, axis, rigidity in hinges:
        stiffness, damping = rigidity / pitch, rope.bending_damping / pitch
        body.add_joint(
            name=f"{body.name}_{name}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis,
            pos=[anchor, 0, 0],
            stiffness=[stiffness, 0, 0],
            damping=[damping, 0, 0],
            armature=_stabilising_inertia(stiffness, damping, spec.option.timestep),
        )


def _stabilising_inertia(stiffness: float, damping: float, timestep: float) -> float:
    return stiffness * timestep**2 / 2 + damping * timestep


def _add_link_geoms(body: "mujoco.MjsBody", model: RopeModel, rope: RopeParameters, pitch: float) -> None:
    import mujoco

    friction = [rope.friction, 0, 0]
    own = ROPE_CONTACT if model.self_contact else 0
    planar = model.kind == "planar_chain"
    body.add_geom(
        name=body.name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[-pitch / 2, 0, 0, pitch / 2, 0, 0],
        size=[rope.radius, 0, 0],
        contype=own,
        conaffinity=own | OBSTACLE_CONTACT | (0 if planar else FLOOR_CONTACT),
        friction=friction,
        condim=3,
    )


def add_floor_friction(
    spec: "mujoco.MjSpec", model: RopeModel, rope: RopeParameters, gravity: float, time_constant: float
) -> None:
    """Coulomb friction between a planar rope and the floor that carries it: each link its own weight's share.

    A planar rope cannot leave the floor, so no contact has to be solved for. Each link rubs along four
    horizontal lines, 45 degrees apart, with at most a fixed force each, as the `frictionloss` of a tendon to
    a point far along the line. The forces add up to an octagon in place of Coulomb's circle: along the motion
    friction is at most 2.6 % too large and 5.2 % too small, and at most 22.5 degrees off its direction, which
    turns the path of a rope that slides to a stop by up to 6 degrees. Six lines would turn it by 4, and cost
    half as much again; contacts that are exact, with each link's weight on a foot of its own, twice as much.
    (Contacts would share out the weight among links that slide and links that rest as they like.)
    """
    weight = gravity * rope.mass / model.links
    # never zero: MJX would leave out the rows that another element of a batch may need
    force = max(rope.friction * weight * math.pi / (2 * FRICTION_DIRECTIONS), 1e-9)
    for line in range(FRICTION_DIRECTIONS):
        angle = math.pi * line / FRICTION_DIRECTIONS
        far = [FAR * math.cos(angle), FAR * math.sin(angle), rope.radius]
        spec.worldbody.add_site(name=f"far{line}", pos=far)
    for link in range(model.links):
        spec.body(link_name(link)).add_site(name=f"{link_name(link)}_floor")
        for line in range(FRICTION_DIRECTIONS):
            tendon = spec.add_tendon(name=f"{link_name(link)}_floor{line}", frictionloss=force)
            tendon.solref_friction = [time_constant, 1]
            tendon.wrap_site(f"{link_name(link)}_floor")
            tendon.wrap_site(f"far{line}")


def _add_point_masses(spec: "mujoco.MjSpec", model: RopeModel, rope: RopeParameters, height: float) -> None:
    """Spheres at the links' centres, each with three slides whose coordinates are its world position.

    Neighbours keep their distance by tendon equalities. There is nothing that bends: a limp rope.
    """
    import mujoco

    pitch, mass = rope.length / model.links, rope.mass / model.links
    axes = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}
    own = ROPE_CONTACT if model.self_contact else 0
    for i in range(model.links):
        x = (i + 0.5) * pitch - rope.length / 2
        body = spec.worldbody.add_body(name=link_name(i), pos=[x, 0, height])
        body.mass, body.inertia = mass, [0.4 * mass * rope.radius**2] * 3
        body.ipos, body.explicitinertial = [0, 0, 0], True
        for axis, direction in axes.items():
            body.add_joint(name=f"{body.name}_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
        body.add_site(name=body.name)
        body.add_geom(
            name=body.name,
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[rope.radius, 0, 0],
            contype=own,
            conaffinity=own | OBSTACLE_CONTACT | FLOOR_CONTACT,
            friction=[rope.friction, 0, 0],
            condim=3,
        )
    for i in range(model.links - 1):
        tendon = spec.add_tendon(name=f"link{i}")
        tendon.wrap_site(link_name(i))
        tendon.wrap_site(link_name(i + 1))
        equality = spec.add_equality(
            name=f"link{i}", type=mujoco.mjtEq.mjEQ_TENDON, objtype=mujoco.mjtObj.mjOBJ_TENDON
        )
        equality.name1 = tendon.name
