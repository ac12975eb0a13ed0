"""Ropes at rest: hung from two hands, clamped at one end, twisted, and what holding them takes."""

from collections.abc import Iterator
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from doojax.benchmarks.physics.cases import (
    GRAVITY,
    Case,
    Finding,
    Settings,
    bent_qpos,
    engine_of,
    fitted_frequency,
    points_of,
    record,
    refused,
    state_of,
    still_hand,
)
from doojax.benchmarks.physics.closed_forms import cantilever_frequency, twist_angle
from doojax.benchmarks.physics.stepping import Stepper, mean_force
from doojax.geometry.curves import catenary, clamped_elastica
from doojax.simulation.build import with_parameters
from doojax.simulation.rope import RopeKind, RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Scene
from doojax.tasks import make_task
from doojax.tasks.starts import straight_qpos

LINKS = (10, 25)  # of ropes that are clamped
TWISTED = (10, 25, 50)
STIFFNESSES = (1e-3, 1e-2, 1e-1)  # N m^2, of ropes that sag by up to their length
STIFF = (1.0, 10.0)  # N m^2, of ropes that vibrate
RISES = (0.0, 0.25)  # m of one hand over the other, for the catenary
HELD_MASSES = (0.2, 2.0)  # kg
SINKING = 0.002  # m in 100 actions that are allowed to hands that are sent nowhere


def catenaries(settings: Settings, engine: str) -> Iterator[Finding]:
    """`dual_gripper`'s rope of 0.8 m, hung from hands 0.5 m apart, level and not: RMS over its length."""
    for rise in RISES:
        scene = replace(make_task("dual_gripper").scene, obstacles=())
        scene = settings.of(scene, scene.control_period)
        moves, still = int(np.ceil(0.3 / (0.1 * scene.control_period))), 12
        step = np.array([[0.3, 0, -rise], [0, 0, 0]]) / moves
        actions = np.concatenate([np.tile(step, (1, moves, 1, 1)), np.zeros((1, still, 2, 3))], axis=1)
        states = state_of(scene, straight_qpos(scene, 2.0)[None])
        simulator = engine_of(scene, engine)
        last, seen = simulator.rollout(states, jnp.asarray(actions, dtype=jnp.float32))
        rope, count = simulator.observations(last).state, scene.links
        length = scene.rope_part.parameters.length
        curve = catenary(rope.grippers[0, 0], rope.grippers[0, 1], jnp.array(length), 2 * count + 1)[1::2]
        rms = np.sqrt(((np.asarray(rope.points[0]) - np.asarray(curve)) ** 2).sum(-1).mean())
        case = Case(engine, settings, {"rise_m": rise})
        yield case.found("catenary_rms_over_length", rms / length, 0.0, "", scale=1.0, within=0.005)
        yield case.found("hanging_stretch", seen.stretch[0, -1], 0.0, "", scale=1.0, within=0.005)


def clamped_scene(
    links: int, stiffness: float, kind: RopeKind = "capsule_chain", end: int = 0, damping: float = 0.3
) -> Scene:
    """A rope of 0.5 m and 50 g held rigidly by link 0 at its ``end``, in one-second control periods.

    ``damping`` is that of bending over ``stiffness`` (s).
    """
    rope = RopeParameters(0.5, 0.005, 0.05, stiffness, stiffness, bending_damping=damping * stiffness)
    clamp = still_hand(0, end, "rigid")
    return Scene("clamped", RopeModel(kind, links), rope, (clamp,), floor=False, timestep=0.004, substeps=250)


def cantilevers(settings: Settings, engine: str, links: tuple[int, ...] = LINKS) -> Iterator[Finding]:
    """Sag and first frequency of a rope of 0.5 m that is clamped at its end."""
    for count in links if engine == "mujoco" else links[:1]:
        scenes = [clamped_scene(count, stiffness, end=-1) for stiffness in STIFFNESSES]
        scene = settings.of(scenes[0], 1.0)
        fields = with_parameters(scene, [one.rope_part.parameters for one in scenes])
        start = np.tile(straight_qpos(scene, 1.0), (len(scenes), 1))
        states = replace(state_of(scene, start), model_fields={k: jnp.asarray(v) for k, v in fields.items()})
        simulator = engine_of(scene, engine)
        last, _ = simulator.rollout(states, jnp.zeros((len(scenes), 8, 1, 3)))
        seen = simulator.observations(last)
        for own, held, one in zip(seen.state.points, seen.hold_points, scenes, strict=True):
            rope, pitch = one.rope_part.parameters, one.rope_part.parameters.length / count
            curve = clamped_elastica(
                rope.length, rope.bending_stiffness, rope.mass * GRAVITY / rope.length, 2001
            )
            exact = np.interp(rope.length - pitch / 2, np.linspace(0, rope.length, 2001), -curve[:, 2])
            tags = {"links": count, "bending_stiffness": rope.bending_stiffness}
            yield Case(engine, settings).found(
                "cantilever_sag", held[0, 2] - own[-1, 2], exact, "m", tags=tags
            )
    for stiffness in STIFF if engine == "mujoco" else STIFF[:1]:
        yield vibration(settings, engine, stiffness)
        if engine == "mujoco":
            yield vibration(replace(settings, timestep=1e-3), engine, stiffness)


def vibration(settings: Settings, engine: str, stiffness: float, links: int = 25) -> Finding:
    """First frequency of a clamped rope that starts straight and swings about its sag, undamped."""
    scene = clamped_scene(links, stiffness, end=-1, damping=0.0)
    rope = scene.rope_part.parameters
    exact = cantilever_frequency(rope.length, stiffness, rope.mass)
    tags = {"bending_stiffness": stiffness, "links": links}
    scene = replace(settings.of(scene, 0.1 / exact), integrator="rk4")
    if settings.timestep is not None:
        tags["step_ms"] = 1e3 * settings.timestep
    try:
        start = state_of(scene, straight_qpos(scene, 1.0)[None])
        states = list(record(engine_of(scene, engine), start, round(12 / exact / scene.control_period)))
    except ValueError as error:
        return refused(Case(engine, settings), "cantilever_frequency", exact, "Hz", error, tags)
    tip = points_of(scene, states)[:, 0, -1, 2]
    times = np.arange(len(states)) * scene.control_period
    found = fitted_frequency(times, tip, exact)
    return Case(engine, settings).found("cantilever_frequency", found, exact, "Hz", tags=tags)


def twists(settings: Settings, engine: str, links: tuple[int, ...] = TWISTED) -> Iterator[Finding]:
    """The angle by which a torque turns the last link of a clamped rope, without gravity; C only."""
    for count in links if engine == "mujoco" else ():
        scene = settings.of(replace(clamped_scene(count, 1e-2, end=-1), gravity=0.0), 1.0)
        stepper = Stepper(scene, straight_qpos(scene, 1.0))
        stepper.twist(count - 1, 5e-3)
        stepper.steps(5.0)
        # a torque on the last link reaches the rope's end: that link, too, is a piece of rope
        rope = scene.rope_part.parameters
        exact = twist_angle(rope.length, rope.twisting_stiffness, 5e-3)
        roll = stepper.roll(count - 1)
        yield Case(engine, settings, {"links": count}).found("twist", roll, exact, "rad")


def holding(settings: Settings, engine: str) -> Iterator[Finding]:
    """The force that carries a hanging rope (C only), and how far hands sink that are sent nowhere."""
    case, scene = Case(engine, settings), make_task("dual_gripper").scene
    if engine == "mujoco":
        hand = Gripper(0, -1, 0.01, max_force=50.0, max_speed=0.15)
        alone = settings.of(replace(scene, obstacles=(), grippers=(hand,)), 1.0)
        down = np.full(alone.links, np.pi / 2)
        samples = Stepper(alone, bent_qpos(alone, np.array([0.0, 0.0, 2.0]), down)).steps(6.0)
        force = mean_force(samples, 4.0, 0, 2)
        yield case.found("carrying_force", force, alone.rope_part.parameters.mass * GRAVITY, "N")
    if settings.converged:
        return  # where hands are sent is no matter of the solver
    strong = tuple(replace(hand, max_force=50.0) for hand in scene.grippers)
    scene = settings.of(replace(scene, obstacles=(), grippers=strong), scene.control_period)
    ropes = [replace(scene.rope_part.parameters, mass=mass) for mass in HELD_MASSES]
    fields = {name: jnp.asarray(value) for name, value in with_parameters(scene, ropes).items()}
    arch = np.linspace(1.0, -1.0, scene.links)
    start = np.tile(bent_qpos(scene, np.array([-0.35, 0.0, 2.0]), arch), (len(ropes), 1))
    states = replace(state_of(scene, start), model_fields=fields)
    _, seen = engine_of(scene, engine).rollout(states, jnp.zeros((len(ropes), 100, 2, 3)))
    hands = np.asarray(seen.states.grippers)
    for own, rope in zip(hands, ropes, strict=True):
        sunk, tags = (own[0] - own[-1])[:, 2].max(), {"rope_mass_kg": rope.mass}
        yield case.found("hands_sunk", sunk, 0.0, "m", scale=1.0, within=SINKING, tags=tags)
