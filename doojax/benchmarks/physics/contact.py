"""Ropes that press on obstacles: around a post, over an edge, onto plates."""

from collections.abc import Iterator
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from doojax.benchmarks.physics.cases import (
    GRAVITY,
    Case,
    Finding,
    Settings,
    bent_qpos,
    engine_of,
    points_of,
    state_of,
    still_hand,
)
from doojax.benchmarks.physics.closed_forms import capstan_friction
from doojax.benchmarks.physics.stepping import Stepper, mean_force
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, Shape
from doojax.simulation.state import SimState
from doojax.tasks import make_task
from doojax.tasks.dual_gripper import TABLE_TOP
from doojax.tasks.starts import straight_qpos
from doojax.types import ShapeKind

FRICTIONS = (0.1, 0.3, 0.5)
POST, ROPE_RADIUS = 0.1, 0.005  # m
PULL, SPEED = 0.2, 0.05  # N behind the post, m/s of the hand ahead
DOWN = np.array([0.0, 0.0, -1.0])
LAID_DOWN = (0.5**0.5, 0.5**0.5, 0.0, 0.0)  # a post's axis along y
EDGE, STRETCH = 0.001, 0.005  # m inside a box, and of the rope's length, that are allowed
THICKNESSES, SPEEDS = (0.002, 0.005, 0.01, 0.02), (0.5, 1.0, 2.0, 4.0)  # m, m/s


def capstan(settings: Settings, engine: str, links: int = 40) -> Iterator[Finding]:
    """The friction that a limp weightless rope shows that is drawn half around a post; C only.

    Behind the post a hand pulls with a fixed force, ahead of it one moves slowly: log of the ratio of forces
    over the angle, beside the friction coefficient.
    """
    for friction in FRICTIONS if engine == "mujoco" else ():
        rope = RopeParameters(0.8, ROPE_RADIUS, 0.2, 1e-5, 1e-5, bending_damping=2e-6, friction=friction)
        post = Obstacle("post", (Shape(ShapeKind.CAPSULE, (POST, POST, 0.2)),))
        behind = Gripper(0, -1, ROPE_RADIUS, max_force=PULL, max_speed=1.0, inertia=0.05)
        ahead = Gripper(links - 1, 1, ROPE_RADIUS, max_force=500.0, max_speed=1.0)
        scene = Scene("capstan", RopeModel("capsule_chain", links), rope, (behind, ahead), (post,), False)
        scene = settings.of(replace(scene, gravity=0.0), 1.0)
        around = POST + ROPE_RADIUS + 1e-3
        along = (np.arange(links) + 0.5) / links * rope.length - rope.length / 2  # from the top of the post
        shape = np.clip(along / around, -np.pi / 2, np.pi / 2)
        leg = rope.length / 2 - np.pi * around / 2
        qpos = bent_qpos(scene, np.array([-around, 0.0, -leg]), shape)
        stepper = Stepper(scene, qpos, {"post": (np.zeros(3), np.array(LAID_DOWN))})
        # the hand behind is sent far away: its force is at the bound
        samples = stepper.steps(
            2.5, lambda time, home=stepper.home: home + np.outer([100.0, SPEED * time], DOWN)
        )
        ratio = mean_force(samples, 1.5, 1, 2) / mean_force(samples, 1.5, 0, 2)
        found = capstan_friction(ratio, np.pi) if ratio > 0 else np.nan
        tags = {"friction": friction}
        yield Case(engine, settings).found("capstan_friction", found, friction, "", tags=tags)


def edge(settings: Settings, engine: str) -> Iterator[Finding]:
    """`dual_gripper`'s rope, drawn taut over the edges of a box on the table: depth and stretch at rest."""
    scene = make_task("dual_gripper").scene
    scene = settings.of(scene, scene.control_period)
    names = [obstacle.name for obstacle in scene.obstacles]
    box, table = names.index("box4"), names.index("table")
    half = scene.obstacles[box].shapes[0].half_size[2]
    qpos = straight_qpos(scene, TABLE_TOP + 2 * half + 0.06)
    layout = scene.layout
    qpos[[layout.places["rope"].qpos[0], *layout.driven[:, 0]]] += 0.8
    states = placed(
        state_of(scene, qpos[None]),
        {table: (0.8, 0.0, TABLE_TOP - 0.06), box: (0.8, 0.0, TABLE_TOP + half)},
        np.array([1.0, 0.0, 0.0, 0.0]),
    )
    actions = np.zeros((1, 6, 2, 3), np.float32)
    actions[0, 0, :, 0] = 0.04, -0.04
    actions[0, :3, :, 2] = -0.06  # in all 18 cm, past the top of the box
    _, seen = engine_of(scene, engine).rollout(states, jnp.asarray(actions))
    case = Case(engine, settings)
    deep = max(-float(seen.clearance[0, -1]), 0.0)
    yield case.found("edge_penetration", deep, 0.0, "m", scale=1.0, within=EDGE)
    yield case.found("edge_stretch", seen.stretch[0, -1], 0.0, "", scale=1.0, within=STRETCH)


def plates(
    settings: Settings, engine: str, thicknesses: tuple[float, ...] = THICKNESSES
) -> Iterator[Finding]:
    """How fast a rope may hit a plate without going through it, and how often it goes through unnoticed."""
    for thickness in thicknesses if engine == "mujoco" else thicknesses[:1]:
        plate = Obstacle("plate", (Shape(ShapeKind.BOX, (0.8, 0.8, thickness / 2)),), friction=0.5)
        rope, chain = make_task("dual_gripper").scene.rope_part.parameters, RopeModel("capsule_chain", 25)
        scene = Scene("plate", chain, rope, (still_hand(0),), (plate,), floor=False, gravity=GRAVITY)
        scene = settings.of(replace(scene, viscosity=0.15), 0.5)
        lean = np.full(chain.links, np.radians(3.0))
        qpos = bent_qpos(scene, np.array([-rope.length / 2, 0.0, 1.08]), lean)
        states = state_of(scene, np.tile(qpos, (len(SPEEDS), 1)), holding=False)
        states = placed(states, {0: (0.0, 0.0, 1.0)}, np.array([1.0, 0.0, 0.0, 0.0]))
        states = eqx.tree_at(lambda s: s.qvel, states, states.qvel.at[:, 2].set(-np.array(SPEEDS)))
        last, seen = engine_of(scene, engine).rollout(states, jnp.zeros((len(SPEEDS), 1, 1, 3)))
        height = points_of(scene, [last])[0, :, :, 2].min(-1)
        through = ~(height > 1.0)
        quiet = through & (np.asarray(seen.faults) == 0).all(1)
        safe = np.argmax(through) if through.any() else len(SPEEDS)
        fastest = SPEEDS[safe - 1] if safe else 0.0
        case = Case(engine, settings, {"thickness_m": thickness})
        yield case.found("plate_fastest_stopped", fastest, SPEEDS[-1], "m/s")
        yield case.found("plate_passed_unnoticed", quiet.mean(), 0.0, "", scale=1.0, within=0.0)


def placed(states: SimState, at: dict[int, tuple[float, float, float]], quaternion: np.ndarray) -> SimState:
    """States with obstacle bodies at these positions (m), all turned alike."""
    position, turned = np.array(states.obstacle_position), np.array(states.obstacle_quaternion)
    for index, where in at.items():
        position[:, index], turned[:, index] = where, quaternion
    return replace(states, obstacle_position=jnp.asarray(position), obstacle_quaternion=jnp.asarray(turned))
