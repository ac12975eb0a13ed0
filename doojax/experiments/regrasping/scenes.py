"""Scenes of arms in a file, which all methods share, and `doojax regrasp-scenes`, which draws them.

A file is an ``.npz``: arrays of S scenes, and in its entry ``header`` JSON with task, seed, rule and how many
attempts were refused for what. Nothing is pickled. Scenes are drawn by `doojax.tasks.arms.drawn_start`, each
from a random stream of its own, which nothing else uses.
"""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from rich.console import Console

from doojax.datasets.progress import progress_bar
from doojax.files import whole_file
from doojax.keys import check_seed
from doojax.reading import NumberKind, checked, read_arrays, require_arrays
from doojax.simulation.grasps import FIELD
from doojax.simulation.state import SimState
from doojax.tasks.arms import RULE, ArmTask, Start, drawn_start
from doojax.tasks.pulling import pulling
from doojax.tasks.threading import threading
from doojax.tasks.untangling import untangling

VERSION = 1  # raise it when scenes of the same seed become others
FORMAT = "doojax arm scenes"
ENVIRONMENTS = {"pulling": pulling, "untangling": untangling, "threading": threading}
COUNTS = {"pulling": 25, "untangling": 25, "threading": 50}  # as in the thesis
FOLDER = Path(__file__).parents[1] / "scene_sets" / "arms"
STATE = ("qpos", "qvel", "commanded", "obstacle_position", "obstacle_quaternion", "holding")


@dataclass(frozen=True)
class ArmScenesHeader:
    """What a file says beside its arrays."""

    task: str
    scene: str  # digest of what is simulated
    seed: int
    rule: str
    attempts: tuple[int, ...]  # of each scene, which attempt it was
    refused: Mapping[str, int]  # attempts, by why


@dataclass(frozen=True, eq=False)
class ArmScenes:
    """S scenes of one task."""

    header: ArmScenesHeader
    states: SimState  # [S]
    goals: Float[np.ndarray, "S 3"]  # world frame, m
    places: Float[np.ndarray, "S G"]  # along the rope where hands hold it, NaN for one that does not

    def __len__(self) -> int:
        """How many scenes there are."""
        return len(self.goals)

    def start(self, number: int) -> Start:
        """One of them."""
        state = jax.tree.map(lambda leaf: jnp.asarray(leaf[number]), self.states)
        return Start(
            state,
            np.asarray(self.goals[number], float),
            tuple(float(place) for place in self.places[number]),
            self.header.attempts[number],
            (),
        )


def regrasp_scenes(
    environment: str, /, *, out: Path | None = None, count: int | None = None, seed: int = 0
) -> None:
    """Draw scenes for doojax regrasp, write them to a file and say how many attempts were refused for what.

    Scene i depends on the seed and its number alone, so a larger set begins with the same scenes.

    Args:
        environment: pulling, untangling or threading.
        out: the file, ending in .scenes; by default ENVIRONMENT.scenes in this folder.
        count: how many; by default as many as the thesis has, 25, 25 or 50.
        seed: of everything that is random.

    Raises:
        ValueError: for an unknown environment, a count below 1, or a file of another kind.
        RuntimeError: no attempt at a scene is accepted.
    """
    task = task_of(environment)
    count, out = COUNTS[task.name] if count is None else count, out or Path(f"{task.name}.scenes")
    _check_name(out)
    if count < 1:
        raise ValueError(f"count is {count}, expected 1 or more")
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    simulator, starts = task.simulator(), []
    with progress_bar(console) as progress:
        bar = progress.add_task(task.name, total=count, note="")
        for number in range(count):
            starts.append(drawn_start(task, simulator, check_seed(seed), number))
            progress.update(bar, advance=1)
    scenes = scenes_of(task, seed, starts)
    save_arm_scenes(out, scenes)
    refused = "; ".join(f"{many} because {why}" for why, many in scenes.header.refused.items())
    console.print(f"wrote {count} scenes to {out}; refused: {refused or 'none'}")


def task_of(environment: str) -> ArmTask:
    """The task of this name.

    Raises:
        ValueError: there is none.
    """
    if environment not in ENVIRONMENTS:
        raise ValueError(f"unknown environment {environment!r}, expected one of {', '.join(ENVIRONMENTS)}")
    return ENVIRONMENTS[environment]()


def scenes_of(task: ArmTask, seed: int, starts: list[Start]) -> ArmScenes:
    """A set of what was drawn."""
    refused = Counter(why for one in starts for why in one.refused)
    header = ArmScenesHeader(
        task.name,
        task.scene.digest,
        seed,
        RULE,
        tuple(one.attempt for one in starts),
        dict(refused.most_common()),
    )
    states = jax.tree.map(
        lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *[one.state for one in starts]
    )
    goals, places = (np.array([getattr(one, name) for one in starts], float) for name in ("goal", "places"))
    return ArmScenes(header, states, goals, places)


def save_arm_scenes(path: Path, scenes: ArmScenes) -> None:
    """Write a set; the file appears whole or not at all.

    Raises:
        ValueError: for a path that does not end in .scenes.
    """
    _check_name(path)
    about = {"format": FORMAT, "version": VERSION, **vars(scenes.header)}
    arrays: dict[str, Any] = {"header": np.frombuffer(json.dumps(about).encode(), np.uint8)}
    arrays |= {f"start/{name}": np.asarray(getattr(scenes.states, name)) for name in STATE}
    arrays |= {"model/" + FIELD: np.asarray(scenes.states.model_fields[FIELD])}
    arrays |= {"goal": scenes.goals, "places": scenes.places}
    with whole_file(path) as file:
        np.savez_compressed(file, **arrays)


def load_arm_scenes(path: Path, task: ArmTask) -> ArmScenes:
    """Read a set of a task's.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no file of scenes, of another version, or of another task or physics.
    """
    what = "a file of scenes of arms"
    content, stored = read_arrays(path, what)
    content = content if isinstance(content, dict) else {}
    kind, version = content.pop("format", None), content.pop("version", None)
    if kind != FORMAT or version != VERSION:
        raise ValueError(
            f"{path} is not {what}: its format is {kind!r}, version {version!r}, expected {FORMAT!r}, "
            f"version {VERSION}: draw scenes with doojax regrasp-scenes"
        )
    try:
        header = checked(content, ArmScenesHeader)
        if header.task != task.name or header.scene != task.scene.digest:
            raise ValueError(
                f"it holds scenes of {header.task}, as simulated by {header.scene}, expected {task.name} and "
                f"{task.scene.digest}: draw scenes with doojax regrasp-scenes {task.name}"
            )
        count, hands = len(header.attempts), len(task.robot.tools)
        bodies, model = len(task.scene.obstacles), stored.get("model/" + FIELD, np.zeros((0, 0, 0)))
        floats: NumberKind = "float"
        expected: dict[str, tuple[NumberKind, tuple[int, ...]]] = {
            "start/qpos": (floats, (count, task.scene.nq)),
            "start/qvel": (floats, (count, task.scene.nv)),
            "start/commanded": (floats, (count, len(task.scene.layout.driven))),
            "start/obstacle_position": (floats, (count, bodies, 3)),
            "start/obstacle_quaternion": (floats, (count, bodies, 4)),
            "start/holding": ("bool", (count, len(task.scene.layout.holds))),
            "model/" + FIELD: (floats, (count, *model.shape[1:])),
            "goal": (floats, (count, 3)),
            "places": (floats, (count, hands)),
        }
        require_arrays(stored, expected)
    except ValueError as error:
        raise ValueError(f"{path} is not {what} that can be used: {error}") from error
    state = {name: jnp.asarray(stored[f"start/{name}"]) for name in STATE}
    faults = jnp.zeros(count, jnp.int32)
    states = SimState(**state, faults=faults, model_fields={FIELD: jnp.asarray(model)})
    return ArmScenes(header, states, stored["goal"], stored["places"])


def arm_scene_file(wanted: Path | None, task: ArmTask) -> Path | None:
    """A set's file: the one of this path, else the one that comes with doojax for the task, if one does."""
    shipped = FOLDER / f"{task.name}.scenes"
    return wanted if wanted is not None else shipped if shipped.exists() else None


def _check_name(path: Path) -> None:
    if path.suffix != ".scenes":
        raise ValueError(f"a file of scenes ends in .scenes, got {path}")
