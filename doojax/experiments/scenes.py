"""Scene sets: the starts, obstacles and goals that all methods of a comparison share, in one file.

How hard scenes are is set by a rule that looks at no method: an obstacle blocks the straight way of the
task's rope point to its goal, yet some way leads there that is wide enough for the rope.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from doojax.datasets.collect import random_trajectories
from doojax.experiments.difficulty import difficulty
from doojax.experiments.statistics import bootstrap
from doojax.files import whole_file
from doojax.keys import numbered, stream
from doojax.planning import Goal, point_goal
from doojax.reading import NumberKind, checked, read_arrays, require_arrays
from doojax.simulation.state import Fault, SimState
from doojax.tasks import make_task
from doojax.tasks.base import Task
from doojax.tasks.ropes import OWN, OtherRope, carrying, with_rope

VERSION = 1  # raise it when scenes of the same seed become others
FOLDER = Path(__file__).parent / "scene_sets"
SCENES = 150
DRAWN = 64  # scenes at once
MOST_DRAWN = 100  # for each that is wanted
RULE = "an obstacle blocks the straight way of the goal's point, yet a way as wide as the rope leads there"
CAUGHT = "; random actions led to the start, and an obstacle held back the last of them"
RANDOM_ACTIONS = 12
TOUCHING, HELD_BACK = 1e-3, 1e-2  # m
STATE = ("qpos", "qvel", "commanded", "obstacle_position", "obstacle_quaternion", "holding")
GOAL = ("targets", "bodies", "tolerance")


@dataclass(frozen=True, eq=False)
class SceneSet:
    """S scenes of one task."""

    task: str
    seed: int
    starts: SimState  # [S]
    goals: Goal  # [S]
    sizes: dict[str, np.ndarray]  # [S], metres: see `difficulty`
    caught: bool = False  # does every scene start where an obstacle holds the rope or a gripper back?
    rope: OtherRope = OWN  # what differs from the task's own; the starts carry it

    def __len__(self) -> int:
        """How many scenes there are."""
        return len(self.starts.qpos)


@dataclass(frozen=True)
class SceneHeader:
    """What the file of a set says beside its arrays."""

    task: str
    seed: int
    rule: str = ""
    caught: bool = False
    rope: OtherRope = OWN


def scenes(
    task: str,
    /,
    *,
    count: int = SCENES,
    seed: int = 0,
    caught: bool = False,
    rope: OtherRope = OWN,
    out: Path | None = None,
) -> None:
    """Draw a set of scenes for trials, write it to a file and print how hard they are.

    Args:
        task: rope_dragging, dual_gripper or toy.
        count: how many scenes.
        seed: of everything that is random.
        caught: start where random actions have led, and an obstacle holds the rope or a gripper back: scenes
            in which recoveries are needed.
        rope: what of the rope differs from the task's own, in all scenes.
        out: the file, ending in .scenes; by default TASK.scenes in this folder.

    Raises:
        ValueError: for an unknown task, a count below 1, a file of another kind, or if hard scenes are rare.
    """
    out = out or Path(f"{task}.scenes")
    drawn = draw_scenes(with_rope(make_task(task), rope), count, seed, caught=caught)
    drawn = replace(drawn, starts=carrying(make_task(task), drawn.starts, rope), rope=rope)
    save_scenes(out, drawn)
    table = Table("metres", "mean", "95 % interval", "least", "greatest", title=f"{count} scenes of {task}")
    for name, values in drawn.sizes.items():
        mean = bootstrap(values)
        interval = f"{mean.low:.3f} to {mean.high:.3f}"
        table.add_row(name, f"{mean.value:.3f}", interval, f"{values.min():.3f}", f"{values.max():.3f}")
    Console().print(table)
    Console(stderr=True).print(f"wrote {out}: {rule(caught)}", highlight=False, markup=False)


def rule(caught: bool) -> str:
    """What all scenes of a set have in common."""
    return RULE + CAUGHT * caught


def draw_scenes(task: Task, count: int, seed: int, *, caught: bool = False) -> SceneSet:
    """The first ``count`` scenes, of a sequence that depends on the seed alone, that obey the rule.

    Raises:
        ValueError: for a count below 1, or where almost no scene obeys the rule.
    """
    if count < 1:
        raise ValueError(f"count is {count}, expected at least 1")
    simulator = task.simulator()
    reset = jax.jit(jax.vmap(simulator.reset))
    aim = jax.jit(jax.vmap(task.sample_goal))
    kind = "caught" if caught else "easy"
    parts: list[Any] = []
    found = drawn = 0
    while found < count:
        if drawn > MOST_DRAWN * count + 10 * DRAWN:
            raise ValueError(f"only {found} of {drawn} scenes of {task.name} are hard enough: {rule(caught)}")
        keys = numbered(stream(seed, "scenes", task.name, kind), range(drawn, drawn + DRAWN))
        start_keys, goal_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        if caught:
            starts, held = _caught(task, simulator, start_keys)
        else:
            starts, held = reset(start_keys), np.ones(DRAWN, dtype=bool)
        obstacles = jax.vmap(simulator.obstacles)(starts)
        places = aim(goal_keys, obstacles)
        begin = np.asarray(simulator.observations(starts).rope.points)[:, task.goal_point]
        sizes = difficulty(obstacles, begin, np.asarray(places), task.workspace)
        hard = held & (sizes["straight_clearance"] < 0) & (sizes["bottleneck"] > task.scene.rope.radius)
        hard &= (np.asarray(starts.faults) & int(Fault.SCENE_OVERFULL)) == 0
        goals = jax.vmap(lambda place: point_goal(task, place))(places)
        parts.append(jax.tree.map(lambda leaf, h=hard: np.asarray(leaf)[h], (starts, goals, sizes)))
        found, drawn = found + int(hard.sum()), drawn + DRAWN
    starts, goals, sizes = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)
    return SceneSet(task.name, seed, starts, goals, sizes, caught)


def save_scenes(path: Path, scenes: SceneSet) -> None:
    """Write a set; the file appears whole or not at all.

    Raises:
        ValueError: for a path that does not end in .scenes.
    """
    if path.suffix != ".scenes":
        raise ValueError(f"a file of scenes ends in .scenes, got {path}")
    header = {"format": "doojax scenes", "version": VERSION, "task": scenes.task, "seed": scenes.seed}
    header |= {"rule": rule(scenes.caught), "caught": scenes.caught, "rope": scenes.rope.given}
    arrays: dict[str, Any] = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    arrays |= {f"start/{name}": np.asarray(getattr(scenes.starts, name)) for name in STATE}
    arrays |= {f"model/{name}": np.asarray(values) for name, values in scenes.starts.model_fields.items()}
    arrays |= {f"goal/{name}": np.asarray(getattr(scenes.goals, name)) for name in GOAL}
    arrays |= {f"size/{name}": values for name, values in scenes.sizes.items()}
    with whole_file(path) as file:
        np.savez_compressed(file, **arrays)


def scene_file(wanted: Path | None, task: str) -> Path:
    """A set's file: the one of this path, else the one that comes with doojax under this name.

    Args:
        wanted: a path or a name; None for what comes with doojax for the task.
        task: whose.

    Raises:
        FileNotFoundError: there is neither; the message lists the sets that come with doojax.
    """
    if wanted is not None and wanted.is_file():
        return wanted
    shipped = {path.stem: path for path in sorted(FOLDER.glob("*.scenes"))}
    name = task if wanted is None else str(wanted).removesuffix(".scenes")
    if name in shipped:
        return shipped[name]
    raise FileNotFoundError(
        f"there is no file of scenes {wanted or name}; doojax scenes draws one, and with doojax come: "
        f"{', '.join(shipped)}"
    )


def load_scenes(path: Path) -> SceneSet:
    """Read a set.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no file of scenes, or of another version; the message says which.
    """
    what = "a file of scenes"
    content, stored = read_arrays(path, what)
    content = content if isinstance(content, dict) else {}
    kind, version = content.pop("format", None), content.pop("version", None)
    if kind != "doojax scenes":
        raise ValueError(f"{path} is not {what}: its format is {kind!r}")
    if version != VERSION:
        raise ValueError(
            f"{path} has version {version!r} of scenes, this doojax uses {VERSION}: draw them anew"
        )
    try:
        header = checked(content, SceneHeader)
        _check_arrays(make_task(header.task), stored)
    except ValueError as error:
        raise ValueError(f"{path} is not {what} that can be used: {error}") from error
    state = {name: jnp.asarray(stored[f"start/{name}"]) for name in STATE}
    count = len(state["qpos"])
    fields = {name[6:]: jnp.asarray(v) for name, v in stored.items() if name.startswith("model/")}
    return SceneSet(
        task=header.task,
        seed=header.seed,
        starts=SimState(**state, faults=jnp.zeros(count, dtype=jnp.int32), model_fields=fields),
        goals=Goal(**{name: jnp.asarray(stored[f"goal/{name}"]) for name in GOAL}),
        sizes={name.removeprefix("size/"): v for name, v in stored.items() if name.startswith("size/")},
        caught=header.caught,
        rope=header.rope,
    )


def _check_arrays(task: Task, stored: dict[str, np.ndarray]) -> None:
    """Raise ValueError unless these are starts and goals of a task's scene."""
    scene, bodies = task.scene, len(task.scene.obstacles)
    qpos, goals = stored.get("start/qpos", np.zeros(0)), stored.get("goal/targets", np.zeros(0))
    count, targets = qpos.shape[:1], goals.shape[1:2]
    if not all((*count, *targets)):
        raise ValueError("it holds no scenes")
    expected: dict[str, tuple[NumberKind, tuple[int, ...]]] = {
        "start/qpos": ("float", (*count, scene.nq)),
        "start/qvel": ("float", (*count, scene.nv)),
        "start/obstacle_position": ("float", (*count, bodies, 3)),
        "start/obstacle_quaternion": ("float", (*count, bodies, 4)),
        "start/holding": ("bool", (*count, task.grippers)),
        "goal/targets": ("float", (*count, *targets, 3)),
        "goal/bodies": ("bool", (*count, *targets, scene.rope_model.links + task.grippers)),
        "goal/tolerance": ("float", count),
        **{name: ("float", count) for name in stored if name.startswith("size/")},
        **{
            name: ("float", (*count, *values.shape[1:]))
            for name, values in stored.items()
            if name.startswith("model/")
        },
    }
    require_arrays(stored, expected)
    for name in expected:
        wrong = np.argwhere(~np.isfinite(stored[name]))
        if len(wrong):
            raise ValueError(f"{name} of scene {wrong[0][0]} is not finite")
    if not (stored["goal/tolerance"] > 0).all() or not stored["goal/bodies"].any(-1).all():
        raise ValueError("a goal has no positive tolerance, or nothing that may reach it")
    inside = np.asarray(task.workspace.contains(jnp.asarray(stored["goal/targets"])))
    if not inside.all():
        raise ValueError(f"the goal of scene {np.argwhere(~inside)[0][0]} lies outside of the workspace")


def _caught(task: Task, simulator: Any, keys: jax.Array) -> tuple[SimState, np.ndarray]:
    """Where random actions led, and whether an obstacle held back the last of them."""
    _, last, seen = random_trajectories(task, simulator, keys, RANDOM_ACTIONS, "constrained")
    moved = seen.states.grippers[:, -1] - seen.states.grippers[:, -2]
    short = jnp.linalg.norm(moved - seen.actions[:, -1], axis=-1).max(-1)
    sound = (seen.faults == 0).all(-1)
    return last, np.asarray(sound & (seen.clearance[:, -1] < TOUCHING) & (short > HELD_BACK))
