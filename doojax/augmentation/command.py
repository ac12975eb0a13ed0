"""`doojax augment`: a data set beside its augmentations, as a data set like any other."""

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from rich.console import Console

from doojax.augmentation.choice import augment_evenly, rarity
from doojax.augmentation.examples import Augmented, Bounds, Examples, Setting, augment
from doojax.augmentation.objectives import Weights, any_transform
from doojax.augmentation.projection import Term
from doojax.augmentation.settings import setting_of, usual
from doojax.datasets.diversity import evenly
from doojax.datasets.files import MANIFEST
from doojax.datasets.manifest import Field
from doojax.datasets.progress import progress_bar
from doojax.datasets.states import state_names
from doojax.datasets.store import Dataset
from doojax.datasets.writer import DatasetWriter
from doojax.files import alone_in, file_digest
from doojax.geometry.motion import RigidMotion
from doojax.keys import check_seed, numbered, stream
from doojax.learning.checkpoints import MODEL, load_model
from doojax.simulation.state import SimState
from doojax.tasks.base import Task
from doojax.tasks.ropes import task_of
from doojax.types import Obstacles, Verdict

SHARD_SIZE = 64
BY_STATE = ("clearance", "stretch")  # besides the states themselves, one value for each state
Way = tuple[float, float, float]
type Augmenter = Callable[[Array, Examples], Augmented]  # from the keys of its targets
STARTS = ("initial_qpos", "initial_qvel", "initial_commanded")


@dataclass(frozen=True)
class _Plan:
    """Which row is what: each example's own row, then its ``copies`` augmentations."""

    trajectories: int  # of the original data set
    periods: int  # of one of them
    steps: int  # of an example
    copies: int

    @property
    def windows(self) -> int:
        return self.periods // self.steps

    @property
    def rows(self) -> int:
        return self.trajectories * self.windows * (1 + self.copies)

    def place(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each row: the original trajectory, the first period, and whether it is an augmentation."""
        example, copy = np.divmod(rows, 1 + self.copies)
        trajectory, window = np.divmod(example, self.windows)
        return trajectory, window * self.steps, copy > 0


def augment_dataset(
    data: Path,
    /,
    *,
    out: Path,
    copies: int = 5,
    steps: int | None = None,
    translation: Way | None = None,
    rotation: Way | None = None,
    distance_tolerance: float | None = None,
    weights: Weights = Weights(),  # noqa: B008
    validity: Path | None = None,
    tries: int = 1,
    seed: int = 0,
) -> None:
    """Write a data set beside augmentations of it: moved rigidly to where they touch as they did.

    Row by row an example and its augmentations, with the example's scene, so that both data sets have the
    same scenes in each split. A rejected augmentation keeps its row, without values but for what was drawn
    and why it was rejected; training leaves such rows out. Runs on from where it was killed, to the same
    bytes. An augmentation depends on the data, the options, the seed and its row alone.

    Args:
        data: the data set, complete.
        out: the new one's folder; new, empty, or the same augmentation unfinished.
        copies: augmentations tried for each example.
        steps: actions of an example: trajectories are cut up, and what remains is left out; 1 gives
            transitions, and by default they stay whole.
        translation: m, either way along each axis, between which transforms are drawn; by default the task's.
        rotation: rad, either way, rotation vector; by default the task's.
        distance_tolerance: m, by how much the least distance to what stays may change; by default the task's.
        weights: of the objective's terms. One of 0 leaves a term's gradient out; its check still holds.
        validity: a run of `doojax train validity` with the data's rope, which refuses transforms; by default
            all are valid, and those of ropes do not tilt.
        tries: targets tried for each augmentation. The projection shortens transforms; of several that are
            accepted one is chosen, so that not what is aimed at but what comes of it is nearly uniform.
        seed: of the transforms.

    Raises:
        FileNotFoundError: for a validity that is not there.
        ValueError: for data that are unfinished or of no rope, counts out of range, or a validity of another
            task or rope.
    """
    check_seed(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # said below
        source = Dataset.open(data)
    plan = _planned(source, copies, steps, tries)
    task = task_of(source.config)
    bounds, projection = usual(task)
    bounds = Bounds(translation or bounds.translation, rotation or bounds.rotation)
    if distance_tolerance is not None:
        projection = replace(projection, distance_tolerance=distance_tolerance)
    setting = setting_of(task, bounds)
    term, digest = (any_transform, {}) if validity is None else _learned_validity(validity, source)
    config = {
        **source.config,
        "states": plan.steps + 1,
        "augmentation": {
            "data": str(data),
            "manifest_sha256": file_digest(data / MANIFEST),
            "copies": copies,
            "steps": steps,
            **asdict(bounds),
            "distance_tolerance": projection.distance_tolerance,
            "weights": asdict(weights),
            **digest,
            **({} if tries == 1 else {"tries": tries}),
            "seed": seed,
        },
    }
    how: Augmenter = partial(augment, setting=setting, config=projection, weights=weights, validity=term)
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    with alone_in(out):
        writer = DatasetWriter.open(
            out, config=config, schema=schema(source, plan.steps), n=plan.rows, shard_size=SHARD_SIZE
        )
        missing = writer.missing_shards()
        counts = Counter()
        if missing and tries > 1:
            how = _evenly(source, task, setting, how, plan, tries, seed)
        with progress_bar(console) as progress:
            total = sum(len(writer.manifest.rows(shard)) for shard in missing)
            bar = progress.add_task(f"augmenting {task.name}", total=total, note="")
            for shard in missing:
                rows = np.array(writer.manifest.rows(shard))
                arrays = _shard(source, task, setting, how, plan, rows, seed)
                writer.write(shard, arrays)
                counts.update(arrays["verdict"].tolist())
                tried = sum(counts.values()) - counts[Verdict.ORIGINAL]
                share = f"{counts[Verdict.ACCEPTED] / max(tried, 1):.0%} accepted"
                progress.advance(bar, len(rows))
                progress.update(bar, note=share)
        writer.finish()
    if missing:
        found = ", ".join(
            f"{counts[verdict]} {verdict.name.lower().replace('_', ' ')}"
            for verdict in Verdict
            if counts[verdict]
        )
        console.print(f"{plan.rows} examples of {plan.steps + 1} states in {out}: {found}")
    else:
        console.print(f"{out} is complete already: {plan.rows} examples")


def schema(source: Dataset, steps: int) -> dict[str, Field]:
    """The fields of ``source``, for examples of ``steps`` actions, and where each example comes from."""
    made, by_state = {}, (*state_names(source.fields)[1], *BY_STATE)
    missing = {*by_state, *STARTS, "actions"}  # where an augmentation was rejected
    for name, field in source.fields.items():
        if name in by_state:
            field = replace(field, shape=(steps + 1, *field.shape[1:]))
        elif name in ("actions", "faults"):
            field = replace(field, shape=(steps, *field.shape[1:]))
        made[name] = replace(field, may_be_missing=name in missing or field.may_be_missing)
    return made | {
        "original": Field((), "int32", "1", "number of the trajectory in the data that were augmented"),
        "first_period": Field((), "int32", "1", "the period of it that the example begins with"),
        "verdict": Field((), "int32", "1", "doojax.types.Verdict"),
        "transform": Field(
            (6,),
            "float32",
            "m, rad",
            "translation, rotation vector, about the centre",
            may_be_missing=True,
        ),
        "centre": Field((3,), "float32", "m", "what the example is turned about", may_be_missing=True),
        "target": Field((6,), "float32", "m, rad", "the transform that was drawn; zero for originals"),
    }


def _planned(source: Dataset, copies: int, steps: int | None, tries: int) -> _Plan:
    lacking = [name for name in ("actions", "faults", *STARTS) if name not in source.fields]
    if lacking:
        raise ValueError(f"{source.path} holds nothing to augment: no field {', '.join(lacking)}")
    state_names(source.fields)
    if "verdict" in source.fields:
        raise ValueError(
            f"{source.path} is augmented already: augment {source.config['augmentation']['data']}"
        )
    if not source.complete:
        raise ValueError(f"{source.path} is unfinished: resume its collection first")
    for name, count in (("copies", copies), ("tries", tries)):
        if count < 1:
            raise ValueError(f"{name} is {count}, expected at least 1")
    periods = source.fields["actions"].shape[0]
    steps = periods if steps is None else steps
    if not 1 <= steps <= periods:
        raise ValueError(f"steps is {steps}, expected 1 to {periods}, as many as the trajectories have")
    return _Plan(len(source), periods, steps, copies)


def _learned_validity(path: Path, source: Dataset) -> tuple[Term, dict[str, str]]:
    """What `doojax train validity` learned, and what the data's config says of it."""
    model, header = load_model(path, task=source.config["task"], kind="validity")
    ropes = header.about.get("rope", {}), source.config.get("rope", {})
    if ropes[0] != ropes[1]:
        told = " and ".join(str(rope or "the task's own") for rope in ropes)
        raise ValueError(f"{path} is of another rope than {source.path}: {told}")
    file = path / MODEL if path.is_dir() else path
    return model, {"validity": str(path), "validity_sha256": file_digest(file)}


def _evenly(
    source: Dataset, task: Task, setting: Setting, how: Augmenter, plan: _Plan, tries: int, seed: int
) -> Augmenter:
    """``how``, but that what is accepted is uniform, as far as some rows tell how it otherwise is not."""
    bounds, seen = np.asarray(setting.bounds, float), []
    some = evenly(np.arange(plan.rows))
    for rows in np.array_split(some, -(-len(some) // SHARD_SIZE)):
        _, examples, _ = _read(source, task, plan, rows)
        found = how(numbered(stream(seed, "augment", "pilot"), np.resize(rows, SHARD_SIZE)), examples)
        accepted = np.asarray(found.verdict) == Verdict.ACCEPTED
        seen.append(np.asarray(found.transform)[: len(rows)][accepted[: len(rows)]])
    weights = rarity(np.concatenate(seen), bounds)
    return lambda keys, examples: augment_evenly(lambda own: how(own, examples), keys, weights, bounds, tries)


def _read(
    source: Dataset, task: Task, plan: _Plan, rows: np.ndarray
) -> tuple[dict[str, np.ndarray], Examples, SimState]:
    """All fields of the originals of some rows; their examples and starts, repeated to fill a batch."""
    trajectory, first, _ = plan.place(rows)
    needed, where = np.unique(trajectory, return_inverse=True)
    values = {name: source[name][needed][where] for name in source.fields}
    kind, names = state_names(source.fields)
    by_state = [name for name in (*names, *BY_STATE) if name in values]
    for name in (*by_state, "actions", "faults"):
        length = plan.steps + (name not in ("actions", "faults"))
        values[name] = np.take_along_axis(
            values[name],
            (first[:, None] + np.arange(length)).reshape(-1, length, *[1] * (values[name].ndim - 2)),
            axis=1,
        )
    for name in STARTS:  # of trajectories are known, of what was cut out of them are not
        values[name][first > 0] = np.nan
    full = np.resize(np.arange(len(rows)), SHARD_SIZE)  # one batch size is one program, and one rounding
    batch = {name: jnp.asarray(value[full]) for name, value in values.items()}
    obstacles, bodies = None, (jnp.zeros((SHARD_SIZE, 0, 3)), jnp.zeros((SHARD_SIZE, 0, 4)))
    if task.scene.obstacles:
        obstacles = Obstacles(**{name: batch[f"obstacle_{name}"] for name in Obstacles.__annotations__})
        bodies = batch["body_position"], batch["body_quaternion"]
    examples = Examples(
        states=kind(**{name: batch[name] for name in names}),
        actions=batch["actions"],
        obstacles=obstacles,
        sound=(batch["faults"] == 0).all(1),
    )
    starts = SimState(
        qpos=batch["initial_qpos"],
        qvel=batch["initial_qvel"],
        commanded=batch["initial_commanded"],
        obstacle_position=bodies[0],
        obstacle_quaternion=bodies[1],
        holding=jnp.ones((SHARD_SIZE, len(task.scene.layout.holds)), dtype=bool),
        faults=jnp.zeros(SHARD_SIZE, dtype=jnp.int32),
        model_fields={},
    )
    return values, examples, starts


def _shard(
    source: Dataset, task: Task, setting: Setting, how: Augmenter, plan: _Plan, rows: np.ndarray, seed: int
) -> dict[str, np.ndarray]:
    """All fields of some rows."""
    trajectory, first, augmented = plan.place(rows)
    values, examples, starts = _read(source, task, plan, rows)
    found = how(numbered(stream(seed, "augment"), np.resize(rows, SHARD_SIZE)), examples)
    changed = _derived(task, setting, examples, found, starts)
    if "stretch" in values:
        stretch = np.resize(values["stretch"], (SHARD_SIZE, *values["stretch"].shape[1:]))
        changed["stretch"] = np.where(np.isnan(changed["clearance"]), np.nan, stretch)
    arrays = {name: value.copy() for name, value in values.items()}
    for name, value in changed.items():
        mine = np.asarray(value)[: len(rows)].astype(arrays[name].dtype)
        mask = augmented.reshape(-1, *[1] * (mine.ndim - 1))
        arrays[name] = np.where(mask, mine, arrays[name])
    verdict = np.where(augmented, np.asarray(found.verdict)[: len(rows)], int(Verdict.ORIGINAL))

    def own(value: Array, original: float) -> np.ndarray:
        return np.where(augmented[:, None], np.asarray(value)[: len(rows)], np.float32(original))

    accepted = np.isin(verdict, (Verdict.ACCEPTED, Verdict.ORIGINAL))[:, None]
    return arrays | {
        "original": trajectory.astype(np.int32),
        "first_period": first.astype(np.int32),
        "verdict": verdict.astype(np.int32),
        "transform": own(found.transform, 0.0),
        "centre": np.where(accepted, np.asarray(found.centre)[: len(rows)], np.float32(np.nan)),
        "target": own(found.target, 0.0),
    }


@eqx.filter_jit
def _moved(
    task: Task, setting: Setting, examples: Examples, found: Augmented, starts: SimState
) -> tuple[SimState, Array | None]:
    def one(states: Any, before: Any, obstacles: Obstacles | None, motion: RigidMotion, start: SimState):
        start = setting.moved_start(task.scene, start, before, motion)
        return start, setting.clearance(states, obstacles)

    return jax.vmap(one)(found.states, examples.states, examples.obstacles, found.motion, starts)


def _derived(
    task: Task, setting: Setting, examples: Examples, found: Augmented, starts: SimState
) -> dict[str, Any]:
    """The fields that an augmentation changes; NaN where it was rejected."""
    moved, clearance = _moved(task, setting, examples, found, starts)
    rejected = (found.verdict != Verdict.ACCEPTED)[:, None]
    changed = {
        **{one.name: getattr(found.states, one.name) for one in fields(found.states)},
        "actions": found.actions,
        "initial_qpos": jnp.where(rejected, jnp.nan, moved.qpos),
        "initial_qvel": jnp.where(rejected, jnp.nan, moved.qvel),
        "initial_commanded": jnp.where(rejected[..., None], jnp.nan, moved.commanded),
    }
    if clearance is not None:
        changed["clearance"] = jnp.where(rejected, jnp.nan, clearance)
    return changed
