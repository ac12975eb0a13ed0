"""Collect random trajectories of a task: `doojax collect`."""

from collections.abc import Callable
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from rich.console import Console

from doojax.actions import ActionSpace, nothing_of, sampled
from doojax.commands import COMMANDS, command_line, load
from doojax.datasets.manifest import Field, Manifest
from doojax.datasets.progress import progress_bar
from doojax.datasets.writer import DatasetWriter
from doojax.files import alone_in
from doojax.keys import check_seed, numbered, stream
from doojax.simulation.engines import resolve_engine
from doojax.simulation.state import Fault, SimState, Simulator
from doojax.tasks import make_task
from doojax.tasks.base import Phase, Task, observed
from doojax.tasks.ropes import OWN, OtherRope, with_rope
from doojax.types import Obstacles, State, Trajectory

SHARD_SIZE = 64
STATES = {  # units and meanings of the fields of states
    "points": ("m", "centres of the rope's links, world frame"),
    "grippers": ("m", "gripper positions, world frame"),
    "positions": ("m", "centres of what is pushed, world frame"),
    "velocities": ("m/s", "their velocities"),
    "hand": ("m", "position of the hand, world frame"),
    "container": ("m", "the middle of the floor of what pours, world frame"),
    "angle": ("rad", "by which it is tilted, from upright towards +x"),
    "receiver": ("m", "the middle of the floor of what is poured into, world frame"),
    "volumes": ("1", "what is in the receiver and in what pours, parts of the whole"),
    "size": ("m", "outer width and height of what pours"),
}


def collect(
    task: str,
    /,
    *,
    phase: Phase = "constrained",
    trajectories: int,
    states: int | None = None,
    engine: str = "auto",
    seed: int = 0,
    rope: OtherRope = OWN,
    out: Path,
) -> None:
    """Collect random trajectories of a task into a data set.

    Runs on from where it was killed, to the same bytes. Trajectory i depends on the task, its scene, phase,
    states, engine, seed and i alone: a longer collection begins with the same trajectories. That is bit for
    bit on MuJoCo C, and but for rounding where XLA simulates, which it does otherwise in another batch.

    Args:
        task: rope_dragging, dual_gripper or planar_pushing.
        phase: unconstrained (phase one, no obstacles) or constrained (phase two).
        trajectories: how many.
        states: per trajectory, one more than actions; the thesis's number by default.
        engine: auto, mujoco, mjx or warp.
        seed: of everything that is random.
        rope: what of the rope differs from the task's own.
        out: the data set's folder; new, empty, or the same collection unfinished.

    Raises:
        ValueError: for an unknown task or engine, counts too small, or a folder that holds other data.
    """
    check_seed(seed)
    the_task = with_rope(make_task(task, phase=phase), rope)
    states = the_task.trajectory_states if states is None else states
    if trajectories < 1:
        raise ValueError(f"trajectories is {trajectories}, expected at least 1")
    if states < 2:
        raise ValueError(f"states is {states}, expected at least 2: one action leads to a second state")
    engine = resolve_engine(engine)
    config = {
        "task": task,
        "scene": the_task.scene.digest,
        "phase": phase,
        "states": states,
        "engine": engine,
        "seed": seed,
        "stream": "/".join(_stream_names(the_task)),
        **({"rope": rope.given} if rope.given else {}),
    }
    with alone_in(out):
        writer = DatasetWriter.open(
            out, config=config, schema=schema(the_task, states - 1), n=trajectories, shard_size=SHARD_SIZE
        )
        console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
        if writer.missing_shards():
            faulty = _write_missing(writer, the_task, engine, seed, states, console)
            console.print(f"{trajectories} trajectories of {states} states in {out}")
            if faulty:
                console.print(f"{faulty} of them have faults: see doojax inspect {out}", style="yellow")
        else:
            console.print(f"{out} is complete already: {trajectories} trajectories")


def _stream_names(task: Task) -> tuple[str, ...]:
    return "collect", task.name, task.phase


def _write_missing(
    writer: DatasetWriter, the_task: Task, engine: str, seed: int, states: int, console: Console
) -> int:
    """Simulate and write what is missing; the number of trajectories that have a fault."""
    missing, faulty = writer.missing_shards(), 0
    simulator = the_task.simulator(engine)
    rows = [writer.manifest.rows(shard) for shard in missing]
    with progress_bar(console) as progress:
        bar = progress.add_task(f"{the_task.name} on {engine}", total=sum(len(row) for row in rows), note="")
        for shard, row in zip(missing, rows, strict=True):
            keys = numbered(stream(seed, *_stream_names(the_task)), row)
            start, _, trajectory = random_trajectories(the_task, simulator, keys, states - 1)
            _require_room(start, row)
            writer.write(shard, stored_arrays(simulator, start, trajectory, np.array(row)))
            faulty += int(np.any(np.asarray(trajectory.faults) != 0, axis=1).sum())
            done = progress.tasks[bar]
            progress.advance(bar, len(row))
            rate = (done.completed or 0) * (states - 1) / max(done.elapsed or 0, 1e-9)
            progress.update(bar, note=f"{rate:,.0f} transitions/s")
    writer.finish()
    return faulty


def command_of(manifest: Manifest, out: Path) -> str | None:
    """The command that made a data set, complete, to be run into the folder ``out``; None if none did."""
    if "imported" in manifest.config:
        return None
    if "augmentation" in manifest.config:
        return _augmentation_of(manifest.config["augmentation"], out)
    given = ("task", "phase", "states", "engine", "seed")
    if not set(given) <= set(manifest.config):
        return None
    arguments = {name: manifest.config[name] for name in given}
    arguments["rope"] = OtherRope(**manifest.config.get("rope", {}))
    return command_line(collect, {**arguments, "trajectories": manifest.trajectories, "out": out})


def _augmentation_of(config: dict[str, Any], out: Path) -> str:
    """The command that made an augmented data set."""
    function = load(str(COMMANDS["augment"][0]))
    weights = type(signature(function).parameters["weights"].default)(**config["weights"])
    lists = {name: tuple(config[name]) for name in ("translation", "rotation")}
    plain = {name: config[name] for name in ("copies", "steps", "distance_tolerance", "seed")}
    plain |= {"validity": Path(config["validity"])} if "validity" in config else {}
    plain |= {"tries": config.get("tries", 1)}
    given = {"data": Path(config["data"]), "out": out, "weights": weights, **lists, **plain}
    return command_line(function, given)


def random_trajectories(
    task: Task, simulator: Simulator, keys: Array, periods: int
) -> tuple[SimState, SimState, Trajectory]:
    """One trajectory of random actions for each of B ``keys``: first and last states, and what was seen."""
    start_keys, action_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
    start = state = _in_shards(partial(_starts, simulator), start_keys)
    seen = observed(simulator, state)
    nothing = nothing_of(task.actions)
    action = jnp.zeros((keys.shape[0], *nothing.shape), nothing.dtype)
    parts = []
    for period in range(periods):
        draw = partial(_actions, task.actions, jnp.asarray(period))
        action = _in_shards(draw, action_keys, seen, action)
        action = jnp.where(jnp.isfinite(action), action, 0.0)  # of a rope that blew up: its fault says so
        state, part = simulator.rollout(state, action[:, None])
        seen = jax.tree.map(lambda leaf: leaf[:, -1], part.states)
        parts.append(part)
    return start, state, joined(parts)


def _in_shards(function: Callable[..., Any], *batch: Any) -> Any:
    """``function(*batch)``, whose batch is filled up to whole shards: XLA rounds small batches otherwise."""
    count = len(jax.tree.leaves(batch)[0])
    filled = np.resize(np.arange(count), -(-count // SHARD_SIZE) * SHARD_SIZE)
    out = function(*jax.tree.map(lambda leaf: leaf[filled], batch))
    return jax.tree.map(lambda leaf: leaf[:count], out)


@eqx.filter_jit
def _starts(simulator: Simulator, keys: Array) -> SimState:
    return jax.vmap(simulator.reset)(keys)


@eqx.filter_jit
def _actions(
    space: ActionSpace, period: Int[Array, ""], keys: Array, states: State, previous: Array
) -> Float[Array, "B ..."]:
    def one(key, state, before):
        return sampled(space, jax.random.fold_in(key, period), state, before)

    return jax.vmap(one)(keys, states, previous)


def joined(parts: list[Trajectory]) -> Trajectory:
    """Trajectories [B, T_i] of which each begins with the state that the one before ended in, as one."""

    def states(leaves):
        return jnp.concatenate([leaves[0], *(leaf[:, 1:] for leaf in leaves[1:])], axis=1)

    def periods(name):
        return jnp.concatenate([getattr(part, name) for part in parts], axis=1)

    return Trajectory(
        states=jax.tree.map(lambda *leaves: states(leaves), *(part.states for part in parts)),
        actions=periods("actions"),
        faults=periods("faults"),
        clearance=states([part.clearance for part in parts]),
        stretch=states([part.stretch for part in parts]),
    )


def schema(task: Task, periods: int) -> dict[str, Field]:
    """The fields of a data set of ``task`` with ``periods`` actions a trajectory."""
    scene, t = task.scene, periods
    bodies, action = max(len(scene.obstacles), 1), nothing_of(task.actions).shape
    shapes = max(sum(len(obstacle.shapes) for obstacle in scene.obstacles), 1)
    commanded = (task.grippers, 2 if scene.planar else 3)
    nan = {"may_be_missing": True}  # in a simulation that blew up
    states = {
        name: Field((t + 1, *value.shape), "float32", *STATES.get(name, ("1", name)), **nan)
        for name, value in vars(task.blank).items()
    }
    every = {
        **states,
        "actions": Field((t, *action), "float32", "m", "what was commanded, such as displacements"),
        "faults": Field((t,), "int32", "1", "bits of doojax.simulation.Fault"),
        "clearance": Field((t + 1,), "float32", "m", "least distance to an obstacle, negative inside", **nan),
        "stretch": Field((t + 1,), "float32", "1", "excess of the rope's length, as a fraction", **nan),
        "obstacle_kind": Field((shapes,), "int32", "1", "doojax.types.ShapeKind of each primitive"),
        "obstacle_centre": Field((shapes, 3), "float32", "m", "centres of the primitives, world frame"),
        "obstacle_quaternion": Field((shapes, 4), "float32", "1", "their orientations, (w, x, y, z)"),
        "obstacle_half_size": Field((shapes, 3), "float32", "m", "their sizes, see doojax.types.ShapeKind"),
        "obstacle_active": Field((shapes,), "bool", "1", "false for parked ones"),
        "body_position": Field((bodies, 3), "float32", "m", "obstacle bodies, for replay"),
        "body_quaternion": Field((bodies, 4), "float32", "1", "obstacle bodies, for replay"),
        "initial_qpos": Field((scene.nq,), "float32", "m, rad", "positions at the start, for replay"),
        "initial_qvel": Field((scene.nv,), "float32", "m/s, rad/s", "velocities at the start, for replay"),
        "initial_commanded": Field(commanded, "float32", "m", "where grippers had been sent, for replay"),
        "environment": Field((), "int32", "1", "trajectories with the same number share a scene"),
    }
    return {name: field for name, field in every.items() if name not in _absent(scene)}


def _absent(scene: Any) -> set[str]:
    """What trajectories of a scene without ropes, or without obstacles, do not have."""
    absent = set() if scene.links else {"stretch"}
    if not scene.obstacles:
        absent |= {f"obstacle_{name}" for name in Obstacles.__annotations__}
        absent |= {"body_position", "body_quaternion", "clearance"}
    return absent


def stored_arrays(
    simulator: Simulator, start: SimState, trajectory: Trajectory, numbers: np.ndarray
) -> dict[str, np.ndarray]:
    """The values of the `schema`'s fields for a batch of trajectories with these ``numbers``."""
    obstacles: Obstacles = jax.vmap(simulator.obstacles)(start)
    states = vars(trajectory.states)
    values = {
        **states,
        "actions": trajectory.actions,
        "faults": trajectory.faults,
        "clearance": trajectory.clearance,
        "stretch": trajectory.stretch,
        **{f"obstacle_{name}": value for name, value in vars(obstacles).items()},
        "body_position": start.obstacle_position,
        "body_quaternion": start.obstacle_quaternion,
        "initial_qpos": start.qpos,
        "initial_qvel": start.qvel,
        "initial_commanded": start.commanded,
        "environment": numbers.astype(np.int32),
    }
    absent = _absent(simulator.scene)
    arrays = {name: np.array(value) for name, value in values.items() if name not in absent}
    for name in {*states, "clearance", "stretch"} - absent:
        arrays[name][~np.isfinite(arrays[name])] = np.nan  # no value: the fault says why
    return arrays


def _require_room(start: SimState, rows: range) -> None:
    overfull = np.flatnonzero(np.asarray(start.faults) & int(Fault.SCENE_OVERFULL))
    if overfull.size:
        raise ValueError(
            f"the scene of trajectory {rows[int(overfull[0])]} is overfull: no room was found for an "
            "obstacle beside the rope; use fewer or smaller obstacles, or a larger region for them"
        )
