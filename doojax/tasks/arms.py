"""Two arms that are to bring a point of a fastened rope to a place, letting go and grasping anew as they do.

The thesis's chapter 5. What is here is common to its environments: what a scene is made of, how a start is
drawn, and by which rule. World frame: z up, the floor at 0; the robot's base at `BASE`.

A scene is the first of its stream's attempts that the rule of `drawn_start` accepts, where the thesis had a
human accept or refuse each. The rule says nothing of topology.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from doojax.geometry.frames import quaternion_from_yaw
from doojax.keys import generator, numbered, stream
from doojax.robots import DUAL_ARM, IkSettings, clearance, dual_arm, inverse_kinematics
from doojax.robots.robot import Robot
from doojax.simulation.grasps import graspable, grasped, rope_point
from doojax.simulation.laying import laid
from doojax.simulation.layout import Observation
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import (
    Arms,
    Attachment,
    Obstacle,
    Scene,
    Shape,
    SolverSettings,
    obstacles_at,
)
from doojax.simulation.state import SimState, at_rest
from doojax.topology.skeletons import Skeleton, make_skeleton
from doojax.types import Obstacles, ShapeKind

BASE = (0.0, 0.0, 0.445)  # m, of the robot above the floor
ARMS = Arms(str(DUAL_ARM), ("left", "right"), BASE)
TIMESTEP, SUBSTEPS = 0.01, 20  # s; a control period of 0.2 s, the mean of the thesis, whose step is 0.004 s
MARGIN = 0.005  # m, that arms keep from what they must not touch at the start
ATTEMPTS = 200
BESIDE, MOST_TRIED = 0.06, 4  # m from an opening; postures of the first hand that are tried there
SETTLING = 2.0  # s, in which the rope comes to rest: 500 steps, as in the thesis's code
RULE = (
    "the first attempt in which the rope is laid clear of obstacles, a tool comes to the goal, the arms are "
    "free, the rope comes to rest without a fault, the hand that shall hold it does, the keypoint is not at "
    "the goal, and the task is solvable in principle: a taut rope reaches the goal, through the openings if "
    "there are any, and at each one hand can hold it before and the other take it behind, clear of all"
)


def armed_scene(
    name: str,
    links: int,
    rope: RopeParameters,
    obstacles: tuple[Obstacle, ...],
    grasp_hold: Literal["point", "rigid"] = "point",
) -> Scene:
    """Arms, and a rope of so many links whose beginning is fastened to the obstacle ``attach``."""
    return Scene(
        name=name,
        rope_model=RopeModel("capsule_chain", links),
        rope=rope,
        grippers=(),
        obstacles=obstacles,
        timestep=TIMESTEP,
        substeps=SUBSTEPS,
        viscosity=1.0,
        solver=SolverSettings(cone="pyramidal", contact_time=2 * TIMESTEP),
        arms=ARMS,
        grasps=True,
        attachments=(Attachment("attach", 0, -1),),
        grasp_hold=grasp_hold,
    )


class Drawn(NamedTuple):
    """One attempt at a scene: everything that is random."""

    centres: dict[str, np.ndarray]  # of the obstacles by name, m
    rope: np.ndarray  # [N + 1, 3], along which it is laid before it comes to rest, m
    joints: dict[str, float]  # of the robot at first, rad
    goal: np.ndarray  # m
    start: np.ndarray | None  # where along the rope each hand holds it at first, NaN for one that does not
    yaws: Mapping[str, float] = MappingProxyType({})  # rad, about z: of obstacles that do not stand straight
    taken_at_once: bool = False  # do hands take the rope where it is laid, before it comes to rest?


@dataclass(frozen=True)
class ArmTask:
    """A rope that is fastened by its beginning, and whose keypoint is to come to the goal."""

    name: str
    scene: Scene
    keypoint: float  # along the rope, 0 to 1
    goal_radius: float  # m, within which the keypoint counts as there
    iterations: int  # of control, after which a trial ends
    draw: Callable[["ArmTask", np.random.Generator], Drawn]
    loops: Callable[
        [dict[str, np.ndarray]], dict[str, np.ndarray]
    ]  # of the skeleton, by the obstacles' places
    threads: tuple[str, ...] = ()  # loops of the skeleton that the rope is to go through first, in this order

    @cached_property
    def robot(self) -> Robot:
        """The arms, as arrays."""
        return dual_arm()

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Indices of the joints that control and motions move: all but fingers."""
        return tuple(i for i, name in enumerate(self.robot.joints) if "finger" not in name)

    @cached_property
    def actuated(self) -> tuple[int, ...]:
        """For each of `moving` its place in an action."""
        names = self.scene.driver.joints  # pyright: ignore[reportAttributeAccessIssue]
        return tuple(names.index(self.robot.joints[i]) for i in self.moving)

    def simulator(self):
        """The scene on MuJoCo C, where grasps that are not there cost nothing."""
        from doojax.simulation.engines.mujoco import MujocoSimulator

        return MujocoSimulator(self.scene, start=_no_start)

    def skeleton(self, state: SimState) -> Skeleton:
        """The obstacle loops of a scene, in the base's frame."""
        centres = {
            obstacle.name: np.asarray(place, float)
            for obstacle, place in zip(self.scene.obstacles, state.obstacle_position, strict=True)
        }
        return make_skeleton({name: loop - np.array(BASE) for name, loop in self.loops(centres).items()})

    def obstacles(self, state: SimState) -> Obstacles:
        """The obstacles in the base's frame."""
        found = obstacles_at(self.scene, state.obstacle_position, state.obstacle_quaternion)
        return eqx.tree_at(lambda o: o.centre, found, found.centre - jnp.array(BASE))


class Start(NamedTuple):
    """A scene, its goal, and which attempt it was."""

    state: SimState
    goal: np.ndarray  # m
    places: tuple[float, ...]  # along the rope where each hand holds it; NaN for one that does not
    attempt: int
    refused: tuple[str, ...]  # why earlier attempts were


def box(name: str, x: float, y: float, z: float) -> Obstacle:
    """A box by its half extents, m."""
    return Obstacle(name, (Shape(ShapeKind.BOX, (x, y, z)),))


def rope_ends(scene: Scene, seen: Observation) -> Float[Array, "*b N1 3"]:
    """Where the links of a chain begin, and where the last ends, m."""
    half = scene.rope_part.parameters.length / scene.links / 2
    axes = seen.half_links / jnp.linalg.norm(seen.half_links, axis=-1, keepdims=True)
    first = seen.state.points - half * axes
    return jnp.concatenate([first, seen.state.points[..., -1:, :] + half * axes[..., -1:, :]], axis=-2)


def drawn_start(task: ArmTask, simulator, seed: int, number: int) -> Start:
    """The scene with this number: the first attempt that nothing speaks against.

    What speaks against one, in this order: the rope is laid into an obstacle; the goal is farther from where
    the rope is fastened than a taut rope reaches, through the openings that it is to be threaded through;
    neither tool comes to the goal; at an opening, the hands cannot hold the rope before it and take it behind
    it; the arms are not free; the rope is at fault when it has come to rest; the hand that shall hold it does
    not reach it without touching anything, or it does not hold; the keypoint is at the goal already.

    Raises:
        RuntimeError: where every attempt is refused, with how often for what.
    """
    refused: list[str] = []
    for attempt in range(ATTEMPTS):
        names = ("regrasping", task.name, "scene", str(number), str(attempt))
        drawn = task.draw(task, generator(seed, *names))
        found = _attempted(task, simulator, drawn, stream(seed, *names, "kinematics"))
        if not isinstance(found, str):
            state, goal, places = found
            return Start(state, goal, places, attempt, tuple(refused))
        refused.append(found)
    often = {why: refused.count(why) for why in dict.fromkeys(refused)}
    raise RuntimeError(f"no start of {task.name} in {ATTEMPTS} attempts: {often}")


def _attempted(
    task: ArmTask, simulator, drawn: Drawn, key: Key[Array, ""]
) -> tuple[SimState, np.ndarray, tuple[float, ...]] | str:
    scene, robot = task.scene, task.robot
    rope = scene.rope_part.parameters
    count = len(scene.obstacles)
    centres = jnp.array([drawn.centres[one.name] for one in scene.obstacles], jnp.float32).reshape(count, 3)
    yaws = [drawn.yaws.get(one.name, 0.0) for one in scene.obstacles]
    turned = jax.vmap(quaternion_from_yaw)(jnp.array(yaws, jnp.float32)).reshape(count, 4)
    joints = np.array(robot.zero)
    for name, angle in drawn.joints.items():
        joints[robot.joints.index(name)] = angle
    qpos = np.zeros(scene.nq)
    qpos[joint_addresses(scene)] = joints
    qpos = laid(scene, qpos, drawn.rope)
    state = graspable(scene, at_rest(scene, jnp.asarray(qpos, jnp.float32), centres, turned))
    seen = simulator.observation(state)
    obstacles = task.obstacles(state)
    if float(_rope_clearance(scene, simulator.obstacles(state), seen)) < 0:
        return "the rope is laid into an obstacle"
    fastened = drawn.centres[scene.attachments[0].obstacle]
    openings = [task.loops(drawn.centres)[name] for name in task.threads]
    way = np.array([fastened, *(loop[:-1].mean(0) for loop in openings), drawn.goal])
    if np.linalg.norm(np.diff(way, axis=0), axis=1).sum() > 0.95 * task.keypoint * rope.length:
        return "a taut rope does not reach the goal"
    goal = jnp.asarray(drawn.goal - np.array(BASE), jnp.float32)
    keys = numbered(key, range(4))
    here = jnp.asarray(joints, jnp.float32)
    if not bool(_is_reached(robot, obstacles, goal, here, keys[:2])):
        return "no tool comes to the goal"
    for loop in openings:
        if not can_be_threaded(robot, obstacles, loop - np.array(BASE), here, keys[:2]):
            return "the hands cannot pass the rope through an opening"
    if float(_clear(robot, obstacles, here)) < MARGIN:
        return "the arms are not free"
    still = jnp.zeros((1, round(SETTLING / scene.control_period), len(scene.driver.joints)))  # pyright: ignore
    faults = False
    if not drawn.taken_at_once:
        state, faults = _settled(simulator, state, still)
    if faults:
        return "the rope is at fault"
    places = (np.nan, np.nan) if drawn.start is None else tuple(float(one) for one in drawn.start)
    seen = simulator.observation(state)
    for hand, place in enumerate(places):
        if np.isnan(place):
            continue
        aim = rope_point(scene, seen, place) - jnp.array(BASE)
        tool = robot.tools[hand]
        found, free = reached(robot, tool, obstacles, aim, seen.state.joints, keys[2 + hand])
        if not bool(free.any()):
            return "no hand reaches the rope"
        state = teleported(scene, state, found[int(jnp.argmax(free))])
        state, faults = _settled(simulator, held_at(simulator, state, hand, place), still)
        seen = simulator.observation(state)
        gap = float(jnp.linalg.norm(rope_point(scene, seen, place) - seen.hands[hand]))
        if faults or gap > 0.02:
            return "the hand does not hold the rope"
        if float(_clear(robot, obstacles, seen.state.joints)) < 0:
            return "the arms touch something"
    tip = rope_ends(scene, seen)[round(task.keypoint * scene.links)]
    if np.linalg.norm(np.asarray(tip) - drawn.goal) <= 2 * task.goal_radius:
        return "the keypoint is at the goal"
    return state, drawn.goal, places


def joint_addresses(scene: Scene) -> np.ndarray:
    """Where the robot's joints are in qpos, in its own order."""
    return scene.layout.places[scene.driver.name].coordinates


def teleported(scene: Scene, state: SimState, joints: Float[Array, "J"]) -> SimState:
    """The state with the robot's joints elsewhere, at rest and commanded to stay there."""
    at = joint_addresses(scene)
    qpos = state.qpos.at[at].set(joints)
    dofs = scene.layout.nv - scene.layout.nq + at  # the rope's free joint has one more position than speeds
    return eqx.tree_at(
        lambda s: (s.qpos, s.qvel, s.commanded),
        state,
        (qpos, state.qvel.at[dofs].set(0), qpos[scene.layout.driven]),
    )


def held_at(simulator, state: SimState, hand: int, place: float) -> SimState:
    """The state in which a hand holds the rope at ``place``; where holds are rigid, turned as it is."""
    rigid = simulator.scene.grasp_hold == "rigid"
    turn = jnp.asarray(simulator.turn_in_hand(state, hand, place)) if rigid else None
    return grasped(simulator.scene, state, hand, place, turn)


def _settled(simulator, state: SimState, still: Array) -> tuple[SimState, bool]:
    batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], state)
    last, trajectory = simulator.rollout(batch, still)
    return jax.tree.map(lambda leaf: leaf[0], last), bool(trajectory.faults.any())


@eqx.filter_jit
def reached(
    robot: Robot,
    tool: str,
    obstacles: Obstacles,
    place: Float[Array, "3"],
    present: Float[Array, "J"],
    key: Key[Array, ""],
    margin: float = MARGIN,
) -> tuple[Float[Array, "S J"], Array]:
    """Joints that bring a tool to a place (base's frame, m), the nearest first; and which are free of all."""
    found = inverse_kinematics(robot, tool, place, present, key, settings=IkSettings(starts=32))
    clear = jax.lax.map(
        lambda joints: clearance(robot, joints, obstacles, -BASE[2]), found.joints, batch_size=16
    )
    return found.joints, found.solved & (clear > margin)


def _is_reached(robot: Robot, obstacles: Obstacles, goal: Array, joints: Array, keys: Array) -> bool:
    return any(
        bool(reached(robot, tool, obstacles, goal, joints, key)[1].any())
        for tool, key in zip(robot.tools, keys, strict=True)
    )


def can_be_threaded(robot: Robot, obstacles: Obstacles, loop: np.ndarray, joints: Array, keys: Array) -> bool:
    """Can one hand hold something before a loop (base's frame, m) while the other takes it behind?

    Before and behind are `BESIDE` from its middle, by the direction of its field, which is right-handed;
    all is clear of everything.
    """
    middle = loop[:-1].mean(0)
    normal = np.cross(loop[1] - loop[0], loop[2] - loop[1])
    offset = BESIDE * normal / np.linalg.norm(normal)
    before, behind = (jnp.asarray(middle + side * offset, jnp.float32) for side in (-1, 1))
    chains = [set(robot.chain(link)) for link in robot.tool_links]
    for first, second in ((0, 1), (1, 0)):
        found, free = reached(robot, robot.tools[first], obstacles, before, joints, keys[0])
        own = np.isin(np.arange(len(robot.joints)), sorted(chains[second] - chains[first]))
        for there in found[np.flatnonzero(np.asarray(free))[:MOST_TRIED]]:
            low, high = jnp.where(own, robot.low, there), jnp.where(own, robot.high, there)
            held = eqx.tree_at(lambda r: (r.low, r.high), robot, (low, high))
            if bool(reached(held, robot.tools[second], obstacles, behind, there, keys[1])[1].any()):
                return True
    return False


@eqx.filter_jit
def _clear(robot: Robot, obstacles: Obstacles, joints: Array) -> Array:
    return clearance(robot, joints, obstacles, -BASE[2])


@eqx.filter_jit
def _rope_clearance(scene: Scene, obstacles: Obstacles, seen: Observation) -> Array:
    from doojax.geometry.sdf import signed_distance

    points = rope_ends(scene, seen)[1:]
    between = jnp.concatenate([points, (points[1:] + points[:-1]) / 2])
    return jnp.min(signed_distance(obstacles, between)) - seen.radius


def _no_start(key: Array) -> SimState:
    raise ValueError("starts of arms are drawn outside of jit: doojax.tasks.arms.drawn_start")


def polyline_of(directions: Float[np.ndarray, "N 3"], begin: np.ndarray, pitch: float) -> np.ndarray:
    """Points of links of one length in these directions, from ``begin`` on, m."""
    steps = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return begin + np.concatenate([np.zeros((1, 3)), np.cumsum(pitch * steps, axis=0)])
