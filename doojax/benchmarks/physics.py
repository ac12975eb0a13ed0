"""How right the physics is: closed forms and MuJoCo C as references, faults and penetration at random.

A hanging rope is compared with the catenary, a clamped one with the elastica, MJX with MuJoCo C from the same
states and actions. The planar rope of `rope_dragging` cannot hang; its closed form is the stop of a sliding
rope, in the tests.
"""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from scipy.stats import ks_2samp

from doojax.benchmarks.rollouts import SEED, sampled_states
from doojax.commands import command_line
from doojax.datasets.collect import random_trajectories
from doojax.experiments.reports import Row, publish_rows, row, show
from doojax.geometry.curves import catenary, clamped_elastica
from doojax.simulation.build import with_parameters
from doojax.simulation.engines import make_simulator, resolve_engine
from doojax.simulation.rope import RopeKind, RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Scene
from doojax.tasks import make_task
from doojax.tasks.starts import at_rest, straight_qpos

DEPTH = 0.002  # m inside an obstacle that is not counted
PERIODS = 20  # actions of a random trajectory
GAP_STATES = 64  # from which two engines are compared
STIFFNESSES = (1e-3, 1e-2, 1e-1)  # N m^2


def physics(
    *,
    trajectories: int = 1000,
    engines: tuple[str, ...] = (),
    links: tuple[int, ...] = (10, 25, 50),
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Measure how far ropes are from closed forms, engines from each other and ropes inside obstacles.

    Args:
        trajectories: random ones of phase two, of each task, in which penetration is counted.
        engines: some of mujoco, mjx and warp; mujoco and mjx by default.
        links: numbers of links of the clamped ropes.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/simulation; by
            default they are only shown.

    Raises:
        ValueError: for an unknown engine, or fewer than one trajectory.
        ModuleNotFoundError: for an engine that is not installed.
    """
    command = command_line(physics, locals())
    engines = tuple(map(resolve_engine, engines or ("mujoco", "mjx")))
    if trajectories < 1:
        raise ValueError(f"trajectories is {trajectories}, expected at least 1")
    console, rows = Console(stderr=True), []
    for task in ("rope_dragging", "dual_gripper"):
        console.print(f"{task}: {trajectories} random trajectories")
        rows += soundness(task, trajectories)
    for engine in engines:
        console.print(f"{engine}: a hanging rope, clamped ropes")
        rows += [*hanging(engine), *(one for count in links for one in sagging(engine, count))]
    for engine in (one for one in engines if one != "mujoco"):
        console.print(f"{engine} beside mujoco")
        rows += gaps("rope_dragging", engine)
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    show(rows, json)


def soundness(task: str, trajectories: int) -> list[Row]:
    """Faults, penetration and stretch in random trajectories of phase two on MuJoCo C."""
    the_task = make_task(task)
    simulator = the_task.simulator("mujoco", "constrained")
    keys = jax.random.split(jax.random.key(SEED), trajectories)
    _, _, seen = random_trajectories(the_task, simulator, keys, PERIODS, "constrained")
    clearance, stretch = np.asarray(seen.clearance)[:, 1:], np.asarray(seen.stretch)
    deep = (clearance < -DEPTH).mean()
    half = 1.96 * np.sqrt(max(deep * (1 - deep), 1e-12) / clearance.size)
    tags, count = {"task": task}, clearance.size
    interval = (max(deep - half, 0.0), deep + half, count)
    return [
        row("penetration_over_2mm_fraction", tags, deep, "", *interval),
        row("deepest_penetration_m", tags, max(-clearance.min(), 0.0), "m", n=count),
        row("largest_stretch_moving", tags, stretch.max(), "", n=count),
        row("faulty_trajectories", tags, (np.asarray(seen.faults) != 0).any(1).sum(), "", n=trajectories),
    ]


def hanging(engine: str) -> list[Row]:
    """The rope of `dual_gripper`, 0.8 m, hung from two points 0.5 m apart, beside the catenary."""
    scene = replace(make_task("dual_gripper").scene, obstacles=())
    states = at_rest(scene, straight_qpos(scene, 1.5)[None])
    inward = np.array([[0.15, 0, 0], [-0.15, 0, 0]]) / 2
    actions = np.concatenate([np.tile(inward, (1, 2, 1, 1)), np.zeros((1, 12, 2, 3))], axis=1)
    simulator = make_simulator(scene, lambda key: states, engine)
    last, seen = simulator.rollout(states, jnp.asarray(actions, dtype=jnp.float32))
    rope = simulator.observations(last).rope
    length, count = scene.rope.length, scene.rope_model.links
    ends = rope.grippers[0]
    curve = catenary(ends[0], ends[1], jnp.array(length), 2 * count + 1)[1::2]
    rms = np.sqrt(((np.asarray(rope.points[0]) - np.asarray(curve)) ** 2).sum(-1).mean())
    tags = {"engine": engine, "rope": scene.rope_model.kind}
    return [
        row("catenary_rms_over_length", tags, rms / length, "", n=count),
        row("stretch", tags, seen.stretch[0, -1], "", n=1),
    ]


def sagging(engine: str, links: int) -> list[Row]:
    """How far the tips of clamped ropes of three stiffnesses are from where the elastica says, relatively."""
    scenes = [clamped_scene(links, stiffness) for stiffness in STIFFNESSES]
    scene, ropes = scenes[0], [one.rope for one in scenes]
    rows, pitch = [], scene.rope.length / links
    fields = {name: jnp.asarray(value) for name, value in with_parameters(scene, ropes).items()}
    states = replace(at_rest(scene, np.tile(straight_qpos(scene, 1.0), (len(ropes), 1))), model_fields=fields)
    simulator = make_simulator(scene, lambda key: states, engine)
    last, _ = simulator.rollout(states, jnp.zeros((len(ropes), 20, 1, 3)))
    points = np.asarray(simulator.observations(last).rope.points)
    for own, rope in zip(points, ropes, strict=True):
        free = rope.length - pitch / 2  # the clamp holds the middle of link 0
        curve = clamped_elastica(free, rope.bending_stiffness, rope.mass * 9.81 / rope.length, 2001)
        sag = np.interp((links - 1) * pitch, np.linspace(0, free, 2001), curve[:, 2])
        tags = {"engine": engine, "links": links, "bending_stiffness": rope.bending_stiffness}
        error = abs((own[-1, 2] - own[0, 2]) / sag - 1)
        rows.append(row("elastica_relative_error", tags, error, ""))
    return rows


def clamped_scene(links: int, stiffness: float, kind: RopeKind = "capsule_chain") -> Scene:
    """A rope of 0.5 m and 50 g held rigidly by the middle of link 0, in one-second control periods."""
    rope = RopeParameters(
        0.5,
        0.005,
        0.05,
        bending_stiffness=stiffness,
        twisting_stiffness=stiffness,
        bending_damping=0.3 * stiffness,
    )
    clamp = Gripper(
        link=0, end=0, radius=0.01, max_force=5e4, max_speed=1.0, inertia=1e3, stiffness=2.5e6, hold="rigid"
    )
    return Scene("clamped", RopeModel(kind, links), rope, (clamp,), floor=False, timestep=0.004, substeps=250)


def gaps(task: str, engine: str) -> list[Row]:
    """Distances between an engine's ropes and MuJoCo C's after one period from the same states and actions.

    In contact, tiny differences grow: there the distributions of where the tail comes to lie, in x and in y,
    are compared by two-sample Kolmogorov-Smirnov tests, whose smaller p-value is given.
    """
    the_task, rows = make_task(task), []
    simulators = {name: the_task.simulator(name) for name in ("mujoco", engine)}
    for contact in (False, True):
        states, actions = sampled_states(the_task, contact, GAP_STATES)
        after = {
            name: np.asarray(one.rollout(states, actions[:, None])[1].states.points[:, -1])
            for name, one in simulators.items()
        }
        gap = np.linalg.norm(after["mujoco"] - after[engine], axis=-1).max(1)
        tags = {"task": task, "engines": f"mujoco, {engine}", "contact": contact}
        for name, percent in (("median", 50), ("p90", 90), ("max", 100)):
            value = np.percentile(gap, percent)
            rows.append(row("engine_gap_m", tags | {"of_states": name}, value, "m", n=GAP_STATES))
        tails = {name: points[:, 0] for name, points in after.items()}
        tests = [ks_2samp(tails["mujoco"][:, axis], tails[engine][:, axis]) for axis in (0, 1)]
        p = min(test.pvalue for test in tests)  # pyright: ignore[reportAttributeAccessIssue]
        rows.append(row("engine_distribution_p", tags, p, "", n=GAP_STATES))
    return rows
