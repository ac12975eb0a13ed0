"""Scene sets: the starts, obstacles and goals that all methods of a comparison share, in one file.

How hard scenes are is set by a rule that looks at no method. In all of them an obstacle blocks the straight
way of the task's rope point to its goal, yet some way leads there that is wide enough for the rope. In narrow
ones no way is wider than three ropes side by side; in dense ones there are twice as many obstacles as the
task has, but for walls and tables. Scenes come from random streams of their own, which nothing trains on.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from rich.console import Console
from rich.table import Table

from doojax.datasets.collect import random_trajectories
from doojax.datasets.progress import announce
from doojax.experiments.reports.statistics import bootstrap
from doojax.experiments.trials.difficulty import difficulty as measured
from doojax.experiments.trials.records import Look
from doojax.files import whole_file
from doojax.keys import numbered, stream
from doojax.planning import Goal
from doojax.reading import NumberKind, checked, read_arrays, require_arrays
from doojax.simulation.state import Fault, SimState, Simulator
from doojax.tasks import make_task
from doojax.tasks.base import Sampling, Task, observed
from doojax.tasks.ropes import OWN, OtherRope, carrying, with_rope
from doojax.types import Obstacles

VERSION = 2  # raise it when scenes of the same seed become others
FOLDER = Path(__file__).parents[1] / "scene_sets"
SCENES = 150
PURPOSE = "scenes"  # of trials
DRAWN = 64  # scenes at once
MOST_DRAWN = 200  # for each that is wanted
Difficulty = Literal["easy", "narrow", "dense"]
CROWD: dict[Difficulty, int] = {"easy": 1, "narrow": 1, "dense": 2}  # times the task's obstacles
NARROW = 3.0  # rope radii: of the largest ball for which there is a way
RULES: dict[Difficulty, str] = {"easy": "", "narrow": "; no way is wider than three ropes"}
RULES["dense"] = "; there are twice as many obstacles as the task has"
RULE = "an obstacle blocks the straight way of the goal's point, yet a way as wide as the rope leads there"
DRAWN_AS_THEY_ARE = "starts and goals as the task draws them"
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
    difficulty: Difficulty = "easy"
    caught: bool = False  # does every scene start where an obstacle holds the rope or a gripper back?
    rope: OtherRope = OWN  # what differs from the task's own; the starts carry it
    purpose: str = PURPOSE  # what they are for: the first name of their random stream
    fixed: bool = False  # does every scene start at the task's fixed start?

    @property
    def stream(self) -> str:
        """The name of the random stream that they come from."""
        names = stream_names(self.task, self.difficulty, self.caught, self.purpose, self.fixed)
        return "/".join(names)

    @property
    def rule(self) -> str:
        """What all of them have in common."""
        if isinstance(make_task(self.task, crowd=self.crowd), Sampling):
            return DRAWN_AS_THEY_ARE
        return rule(self.difficulty, self.caught)

    @property
    def crowd(self) -> int:
        """How many times the task's obstacles there are, for `doojax.tasks.make_task`."""
        return CROWD[self.difficulty]

    def __len__(self) -> int:
        """How many scenes there are."""
        return len(self.starts.qpos)


@dataclass(frozen=True)
class SceneHeader:
    """What the file of a set says beside its arrays."""

    task: str
    seed: int
    difficulty: Difficulty
    stream: str
    rule: str = ""
    caught: bool = False
    rope: OtherRope = OWN
    fixed: bool = False


def scenes(
    task: str,
    /,
    *,
    count: int = SCENES,
    seed: int = 0,
    difficulty: Difficulty = "easy",
    caught: bool = False,
    fixed: bool = False,
    rope: OtherRope = OWN,
    out: Path | None = None,
) -> None:
    """Draw a set of scenes for trials, write it to a file and print how hard they are.

    Args:
        task: rope_dragging, dual_gripper, engine_bay or toy.
        count: how many scenes.
        seed: of everything that is random.
        difficulty: easy (an obstacle blocks the straight way), narrow (and no way is wider than three ropes)
            or dense (and there are twice as many obstacles).
        caught: start where random actions have led, and an obstacle holds the rope or a gripper back: scenes
            in which recoveries are needed.
        fixed: start at the task's own fixed start, with its own goals: engine_bay has one.
        rope: what of the rope differs from the task's own, in all scenes.
        out: the file, ending in .scenes; by default TASK.scenes, or TASK_DIFFICULTY.scenes, in this folder.

    Raises:
        ValueError: for an unknown task, a count below 1, a file of another kind, a task without a fixed
            start, or if hard scenes are rare.
    """
    names = [task, *[difficulty][: difficulty != "easy"], *["caught"][:caught], *["fixed"][:fixed]]
    out = out or Path(f"{'_'.join(names)}.scenes")
    the_task: Any = make_task(task, crowd=crowd_of(difficulty))
    if fixed and not hasattr(the_task, "starts"):
        raise ValueError(f"{task} has no fixed start: leave --fixed out")
    the_task = replace(the_task, starts="fixed") if fixed else the_task
    announce(f"drawing {count} {difficulty} scenes of {task}: a minute or so")
    drawn = draw_scenes(with_rope(the_task, rope), count, seed, difficulty, caught=caught)
    drawn = replace(drawn, starts=carrying(the_task, drawn.starts, rope), rope=rope)
    save_scenes(out, drawn)
    title = f"{count} {difficulty} scenes of {task}"
    table = Table("metres", "mean", "95 % interval", "least", "greatest", title=title)
    for name, values in drawn.sizes.items():
        mean = bootstrap(values)
        interval = f"{mean.low:.3f} to {mean.high:.3f}"
        table.add_row(name, f"{mean.value:.3f}", interval, f"{values.min():.3f}", f"{values.max():.3f}")
    Console().print(table)
    Console(stderr=True).print(f"wrote {out}: {drawn.rule}", highlight=False, markup=False)


def rule(difficulty: Difficulty, caught: bool) -> str:
    """What all scenes of a set have in common."""
    return RULE + RULES[difficulty] + CAUGHT * caught


def stream_names(
    task: str, difficulty: Difficulty, caught: bool, purpose: str = PURPOSE, fixed: bool = False
) -> tuple[str, ...]:
    """The names of a set's random stream, see `doojax.keys.stream`."""
    return (purpose, task, difficulty, *["caught"][:caught], *["fixed"][:fixed])


def crowd_of(difficulty: Difficulty) -> int:
    """How many times the task's obstacles scenes of a difficulty have.

    Raises:
        ValueError: for an unknown difficulty.
    """
    if difficulty not in CROWD:
        raise ValueError(
            f"unknown difficulty {difficulty!r}, expected one of {', '.join(get_args(Difficulty))}"
        )
    return CROWD[difficulty]


def draw_scenes(
    task: Task,
    count: int,
    seed: int,
    difficulty: Difficulty = "easy",
    *,
    caught: bool = False,
    purpose: str = PURPOSE,
) -> SceneSet:
    """The first ``count`` scenes that obey the rule, of a sequence that depends on seed and rule alone.

    Args:
        task: with as many obstacles as `crowd_of` says for the difficulty.
        count: how many.
        seed: of everything that is random.
        difficulty: which rule.
        caught: start where an obstacle holds the rope or a gripper back.
        purpose: the first name of their random stream; those of another are other scenes.

    Raises:
        ValueError: for a count below 1, an unknown difficulty, or where almost no scene obeys the rule.
    """
    crowd_of(difficulty)
    if count < 1:
        raise ValueError(f"count is {count}, expected at least 1")
    simulator = task.simulator("mujoco")  # on every machine: where ropes get caught, engines differ
    fixed = getattr(task, "starts", None) == "fixed"
    root = stream(seed, *stream_names(task.name, difficulty, caught, purpose, fixed))
    radius = Look.of(task.scene).rope_radius
    widest = NARROW * radius if difficulty == "narrow" else np.inf
    parts: list[Any] = []
    found = drawn = 0
    while found < count:
        if drawn > MOST_DRAWN * count + 10 * DRAWN:
            raise ValueError(
                f"only {found} of {drawn} scenes of {task.name} are hard enough: {rule(difficulty, caught)}"
            )
        keys = numbered(root, range(drawn, drawn + DRAWN))
        start_keys, goal_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        if caught:
            starts, held = _caught(task, simulator, start_keys)
        else:
            starts, held = _starts(simulator, start_keys), np.ones(DRAWN, dtype=bool)
        obstacles = jax.vmap(simulator.obstacles)(starts)
        goals = _goals(task, goal_keys, obstacles)
        begin = np.asarray(observed(simulator, starts).bodies())[:, task.goal_point]
        if not isinstance(task, Sampling):
            sizes = measured(obstacles, begin, np.asarray(goals.targets)[:, 0], task.workspace)
            hard = held & (sizes["straight_clearance"] < 0) & (sizes["bottleneck"] > radius)
            hard &= sizes["bottleneck"] <= widest
        else:  # a goal that is no place has no straight way: every scene counts
            sizes = {"distance": np.linalg.norm(np.asarray(goals.targets)[:, 0] - begin, axis=-1)}
            hard = held
        hard &= (np.asarray(starts.faults) & int(Fault.SCENE_OVERFULL)) == 0
        parts.append(jax.tree.map(lambda leaf, h=hard: np.asarray(leaf)[h], (starts, goals, sizes)))
        found, drawn = found + int(hard.sum()), drawn + DRAWN
    starts, goals, sizes = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)
    return SceneSet(task.name, seed, starts, goals, sizes, difficulty, caught, purpose=purpose, fixed=fixed)


@eqx.filter_jit
def _starts(simulator: Simulator, keys: Array) -> SimState:
    return jax.vmap(simulator.reset)(keys)


@eqx.filter_jit
def _goals(task: Task, keys: Array, obstacles: Obstacles) -> Goal:
    return jax.vmap(task.sample_goal)(keys, obstacles)


def save_scenes(path: Path, scenes: SceneSet) -> None:
    """Write a set; the file appears whole or not at all.

    Raises:
        ValueError: for a path that does not end in .scenes.
    """
    if path.suffix != ".scenes":
        raise ValueError(f"a file of scenes ends in .scenes, got {path}")
    header = {"format": "doojax scenes", "version": VERSION, "task": scenes.task, "seed": scenes.seed}
    header |= {
        "stream": scenes.stream,
        "difficulty": scenes.difficulty,
        "caught": scenes.caught,
        **({"fixed": True} if scenes.fixed else {}),
        "rope": scenes.rope.given,
    }
    header |= {"rule": scenes.rule}
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
        _check_arrays(make_task(header.task, crowd=crowd_of(header.difficulty)), stored)
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
        difficulty=header.difficulty,
        caught=header.caught,
        rope=header.rope,
        purpose=header.stream.split("/")[0],
        fixed=header.fixed,
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
        "start/holding": ("bool", (*count, sum(hand.link is not None for hand in scene.grippers))),
        "goal/targets": ("float", (*count, *targets, 3)),
        "goal/bodies": ("bool", (*count, *targets, len(task.blank.bodies()))),
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


def _caught(task: Task, simulator: Any, keys: Array) -> tuple[SimState, np.ndarray]:
    """Where random actions led, and whether an obstacle held back the last of them."""
    _, last, seen = random_trajectories(task, simulator, keys, RANDOM_ACTIONS)
    moved = seen.states.grippers[:, -1] - seen.states.grippers[:, -2]
    short = jnp.linalg.norm(moved - seen.actions[:, -1], axis=-1).max(-1)
    sound = (seen.faults == 0).all(-1)
    return last, np.asarray(sound & (seen.clearance[:, -1] < TOUCHING) & (short > HELD_BACK))
