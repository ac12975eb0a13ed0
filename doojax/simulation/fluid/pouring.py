"""A container that pours into another: a scene as plain data, and its simulator."""

import hashlib
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from doojax.modules import Jittable
from doojax.parts import in_parts, worth_parts
from doojax.simulation.fluid.containers import Container, boxes_of, filled, inside
from doojax.simulation.fluid.settings import FluidSettings
from doojax.simulation.fluid.step import Fluid, step
from doojax.simulation.fluid.walls import Walls
from doojax.simulation.layout import Observation
from doojax.simulation.scenes import Obstacle, primitives_at
from doojax.simulation.state import Fault, SimState, Start, find_faults
from doojax.types import Obstacles, PouringState, ShapeKind, Trajectory

FLOOR = (50.0, 50.0, 0.25)  # m, half sizes of the box below z = 0; spilled fluid gets metres away
PART = 4  # elements in one call, of a large batch on a CPU


@dataclass(frozen=True)
class PouringScene:
    """Everything that is compiled; where the obstacles are is data."""

    name: str
    container: Container  # what actions move, in the plane of x and z
    receiver: Container
    obstacles: tuple[Obstacle, ...]  # the receiver first, of five boxes; upright boxes
    fluid: FluidSettings
    particles: int
    ramp: int = 40  # looks of the controller in which its target goes from here to where it is sent
    looks: int = 80  # of the controller, in a control period
    look: float = 0.02  # s, between two of them
    follow: float = 0.33  # of what is missing in place that the controller makes good by the next look
    turn: float = 0.4  # of what is missing in angle
    fastest: float = 1.5  # m/s, at most, of the container; else what was held up would jump through things
    fastest_turn: float = 5.0  # rad/s
    fall: float = 1.2  # m, the most that fluid falls

    def __post_init__(self):
        """Refuse what does not fit, and what is too fast for the time step."""
        filled(self.container, (0.0, 0.0, 0.0), self.particles, self.fluid)  # raises where they do not fit
        if abs(self.substeps * self.fluid.time_step - self.look) > 1e-9:
            raise ValueError(
                f"the fluid's time step is {self.fluid.time_step} s, expected a whole part of {self.look} s"
            )
        boxes = [shape for one in self.obstacles for shape in one.shapes]
        if any(shape.kind != ShapeKind.BOX for shape in boxes):
            raise ValueError("a pouring scene's obstacles are of several kinds, expected boxes alone")
        thinnest = min(self.container.wall, *(2 * min(shape.half_size) for shape in boxes))
        self.fluid.require_speed((2 * self.fluid.gravity * self.fall) ** 0.5, thinnest)

    @property
    def substeps(self) -> int:
        """Of the fluid between two looks."""
        return max(1, round(self.look / self.fluid.time_step))

    @property
    def control_period(self) -> float:
        """Seconds of physics per action."""
        return self.looks * self.look

    @property
    def digest(self) -> str:
        """Differs where anything here does."""
        return hashlib.sha256(repr(self).encode()).hexdigest()[:16]

    @property
    def nq(self) -> int:
        """Coordinates of the particles, then x, z (m) and angle (rad) of the container."""
        return self.particles * self.fluid.dimensions + 3

    @property
    def nv(self) -> int:
        """Velocities of the particles."""
        return self.particles * self.fluid.dimensions

    links, planar, rope, floor, grippers = 0, False, None, True, ()  # see `Scene`

    @property
    def plane_height(self) -> float:
        """What stands for the size of what is handled, m: a particle's radius."""
        return self.fluid.radius

    @property
    def layout(self) -> Any:
        """That nothing is held."""
        return SimpleNamespace(holds=())


class PouringSimulator(Jittable):
    """A pouring scene, in pure JAX; see `doojax.simulation.Simulator`."""

    scene: PouringScene = eqx.field(static=True)
    start: Start = eqx.field(static=True)

    def reset(self, key: Array) -> SimState:
        """A start drawn from the task's distribution."""
        return self.start(key)

    def step(self, state: SimState, action: Float[Array, "1 3"]) -> SimState:
        """One control period: carry the container by x and z (m), and turn it to an angle (rad)."""
        return self._period(state, action)[0]

    def observe(self, state: SimState) -> PouringState:
        """What learners and planners see."""
        scene = self.scene
        fluid, pose = split(scene, state.qpos)
        place, receiver = self._place(pose), state.obstacle_position[0]
        poured = inside(scene.receiver, receiver, jnp.zeros(()), fluid)
        kept = inside(scene.container, place, pose[2], fluid)
        volumes = jnp.stack([(poured & ~kept).mean(), kept.mean()])
        size = jnp.array([scene.container.width + 2 * scene.container.wall, scene.container.height])
        return PouringState(place, pose[2], receiver, volumes.astype(pose.dtype), size)

    def observations(self, states: SimState) -> Observation:
        """A batch of what `observe` gives."""
        return jax.vmap(self._observation)(states)

    def obstacles(self, state: SimState) -> Obstacles:
        """The boxes of receiver and plant where they are."""
        return primitives_at(self.scene.obstacles, state.obstacle_position, state.obstacle_quaternion)

    def rollout(self, states: SimState, actions: Float[Array, "B T 1 3"]) -> tuple[SimState, Trajectory]:
        """T control periods of B elements. Returns the last states and all that was seen."""
        if worth_parts(PART, states, actions):
            return in_parts(self._rollout, PART, states, actions)
        return self._rollout(states, actions)

    @eqx.filter_jit
    def _rollout(self, states: SimState, actions: Float[Array, "B T 1 3"]) -> tuple[SimState, Trajectory]:
        return jax.vmap(self._rollout_one)(states, actions)

    def _rollout_one(self, state: SimState, actions: Float[Array, "T 1 3"]) -> tuple[SimState, Trajectory]:
        def period(state: SimState, action: Array) -> tuple:
            after, near = self._period(state, action)
            return after, (self.observe(after), after.faults, near)

        last, (seen, faults, near) = jax.lax.scan(period, state, actions)
        first = self.gap(self.obstacles(state), split(self.scene, state.qpos)[1])
        states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), self.observe(state), seen)
        clearance = jnp.concatenate([first[None], near])
        return last, Trajectory(states, actions, faults, clearance, jnp.zeros_like(clearance))

    def films(self, state: SimState, actions: Float[Array, "T 1 3"]) -> tuple[Array, Array]:
        """Particles [T looks, P, D] (m) and the container's poses [T looks, 3] (m, rad), for pictures."""

        def period(state: SimState, action: Array) -> tuple:
            looks = self._looks(state, action)
            return self._after(state, action, looks), (looks[1], looks[2])

        _, (fluids, poses) = jax.lax.scan(period, state, actions)
        flat = fluids.positions.reshape(-1, *fluids.positions.shape[2:])
        return flat, poses.reshape(-1, 3)

    def gap(self, obstacles: Obstacles, pose: Float[Array, "3"]) -> Float[Array, ""]:
        """How far the container's hull is at least from boxes and floor, m; negative where they meet.

        The largest gap along the axes of both, in the plane: of two that do not overlap it is at most their
        distance, and it is negative exactly where they overlap (separating axes).
        """
        box = self.scene.container
        x, low, high = box.width / 2 + box.wall, -box.wall, box.height
        cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
        axes = jnp.array([[1.0, 0.0], [0.0, 1.0]])
        own = jnp.stack([jnp.stack([cosine, -sine]), jnp.stack([sine, cosine])])
        corners = jnp.array([[-x, low], [x, low], [-x, high], [x, high]]) @ own + pose[:2]
        centre, half = obstacles.centre[:, ::2], obstacles.half_size[:, ::2]
        signs = jnp.array([[-1, -1], [1, -1], [-1, 1], [1, 1.0]])
        theirs = centre[:, None] + signs * half[:, None]  # [M, 4, 2]

        def along(axis: Array) -> Array:
            ours, others = corners @ axis, theirs @ axis
            return jnp.maximum(others.min(1) - ours.max(), ours.min() - others.max(1))

        gaps = jnp.stack([along(axis) for axis in (*axes, *own)]).max(0)
        beside = jnp.abs(obstacles.centre[:, 1]) - obstacles.half_size[:, 1] - box.depth / 2 - box.wall
        gaps = jnp.where(obstacles.active, jnp.maximum(gaps, beside), jnp.inf)
        return jnp.minimum(gaps.min(initial=jnp.inf), corners[:, 1].min())

    def _period(self, state: SimState, action: Float[Array, "1 3"]) -> tuple[SimState, Float[Array, ""]]:
        looks = self._looks(state, action)
        return self._after(state, action, looks), looks[4].min()

    def _after(self, state: SimState, action: Array, looks: tuple) -> SimState:
        _, fluid, poses, faults, _ = looks
        last = jax.tree.map(lambda leaf: leaf[-1], fluid)
        qpos = jnp.concatenate([last.positions.reshape(-1), poses[-1]])
        qvel = last.velocities.reshape(-1)
        every = jax.lax.reduce(faults, jnp.zeros((), faults.dtype), jax.lax.bitwise_or, (0,))
        return eqx.tree_at(
            lambda s: (s.qpos, s.qvel, s.commanded, s.faults),
            state,
            (qpos, qvel, self._target(state, action)[None], every | find_faults(qpos, qvel)),
        )

    def _limited(self, way: Float[Array, "3"]) -> Float[Array, "3"]:
        """As much of a way in a look (m, m, rad) as speeds allow."""
        far, turned = self.scene.fastest * self.scene.look, self.scene.fastest_turn * self.scene.look
        length = jnp.sqrt((way[:2] ** 2).sum() + 1e-12)
        return jnp.append(way[:2] * jnp.minimum(1.0, far / length), jnp.clip(way[2], -turned, turned))

    def _target(self, state: SimState, action: Float[Array, "1 3"]) -> Float[Array, "3"]:
        here = split(self.scene, state.qpos)[1]
        return jnp.array([here[0] + action[0, 0], here[1] + action[0, 1], action[0, 2]])

    def _looks(self, state: SimState, action: Float[Array, "1 3"]) -> tuple:
        """The controller's looks: None, fluids, poses, faults and gaps after each."""
        scene = self.scene
        positions, pose = split(scene, state.qpos)
        fluid = Fluid(positions, state.qvel.reshape(positions.shape))
        target, obstacles = self._target(state, action), self.obstacles(state)
        gain = jnp.array([scene.follow, scene.follow, scene.turn])

        def look(carry: tuple[Fluid, Array], number: Array) -> tuple:
            fluid, here = carry
            wanted = pose + (target - pose) * jnp.minimum(1.0, (number + 1) / scene.ramp)
            there = here + self._limited(gain * (wanted - here))
            gap = self.gap(obstacles, there)
            there = jnp.where(gap < 0, here, there)  # cancelled: it would meet something
            fluid, faults = self._flow(fluid, obstacles, here, there)
            return (fluid, there), (None, fluid, there, faults, jnp.where(gap < 0, 0.0, gap))

        return jax.lax.scan(look, (fluid, pose), jnp.arange(scene.looks))[1]

    def _flow(
        self, fluid: Fluid, obstacles: Obstacles, here: Float[Array, "3"], there: Float[Array, "3"]
    ) -> tuple[Fluid, Int[Array, ""]]:
        """The fluid while the container goes from one pose to another, at constant speed."""
        scene, count = self.scene, self.scene.substeps

        def substep(carry: tuple[Fluid, Array], number: Array) -> tuple:
            fluid, faults = carry
            pose = here + (there - here) * (number + 1) / count
            found = step(scene.fluid, self._walls(obstacles, pose, (there - here) / scene.look), fluid)
            faults |= _bits(found.dropped, found.too_fast, found.entered)
            return (found.fluid, faults), None

        begin = fluid, jnp.zeros((), jnp.int32)
        return jax.lax.scan(substep, begin, jnp.arange(count))[0]

    def _walls(self, obstacles: Obstacles, pose: Float[Array, "3"], rate: Float[Array, "3"]) -> Walls:
        """The container's boxes, those of the obstacles, and the floor."""
        place = self._place(pose)
        own = boxes_of(self.scene.container, place, pose[2])
        floor = Obstacles(
            kind=jnp.full(1, int(ShapeKind.BOX), jnp.int32),
            centre=jnp.array([[0.0, 0.0, -FLOOR[2]]]),
            quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
            half_size=jnp.array([FLOOR]),
            active=jnp.ones(1, bool),
        )
        every = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), own, obstacles, floor)
        arm = own.centre - place
        speed = jnp.stack(
            [rate[0] + rate[2] * arm[:, 2], 0 * arm[:, 0], rate[1] - rate[2] * arm[:, 0]], axis=1
        )
        spin = jnp.zeros((5, 3)).at[:, 1].set(rate[2])
        rest = jnp.zeros((every.kind.shape[0] - 5, 3))
        return Walls(every, jnp.concatenate([speed, rest]), jnp.concatenate([spin, rest]))

    def _place(self, pose: Float[Array, "3"]) -> Float[Array, "3"]:
        return jnp.stack([pose[0], jnp.zeros_like(pose[0]), pose[1]])

    def _observation(self, state: SimState) -> Observation:
        seen = self.observe(state)
        nothing = jnp.zeros((0, 3))
        return Observation(seen, seen.container[None], nothing, nothing, jnp.zeros(()))


def split(scene: PouringScene, qpos: Float[Array, "nq"]) -> tuple[Float[Array, "P D"], Float[Array, "3"]]:
    """Particles (m), and x, z (m) and angle (rad) of the container."""
    return qpos[: scene.nv].reshape(scene.particles, scene.fluid.dimensions), qpos[scene.nv :]


def start_at(scene: PouringScene, x: Array, z: Array, position: Array, quaternion: Array) -> SimState:
    """An upright container at x and z (m), filled; obstacle bodies at their poses."""
    particles = jnp.asarray(filled(scene.container, (0.0, 0.0, 0.0), scene.particles, scene.fluid))
    shift = jnp.stack([x, z] if scene.fluid.dimensions == 2 else [x, jnp.zeros_like(x), z])
    pose = jnp.stack([x, z, jnp.zeros_like(x)])
    return SimState(
        qpos=jnp.concatenate([(particles + shift).reshape(-1), pose]),
        qvel=jnp.zeros(scene.nv),
        commanded=pose[None],
        obstacle_position=position,
        obstacle_quaternion=quaternion,
        holding=jnp.zeros(0, bool),
        faults=jnp.zeros((), jnp.int32),
        model_fields={},
    )


def _bits(dropped: Bool[Array, ""], too_fast: Bool[Array, ""], entered: Bool[Array, ""]) -> Int[Array, ""]:
    found = jnp.where(dropped, int(Fault.NEIGHBOURS_DROPPED), 0)
    found |= jnp.where(too_fast, int(Fault.STEP_TOO_LONG), 0)
    return (found | jnp.where(entered, int(Fault.PASSED_THROUGH), 0)).astype(jnp.int32)
