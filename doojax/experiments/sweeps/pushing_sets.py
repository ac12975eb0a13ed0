"""What each method of the augmentation study makes of a set of pushed trajectories."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from doojax.augmentation import Examples, setting_of, usual
from doojax.augmentation.command import augment_dataset
from doojax.augmentation.examples import drawn, transformed
from doojax.augmentation.objectives import Weights
from doojax.datasets import Dataset
from doojax.keys import numbered, stream
from doojax.learning.fit import FitConfig, Report, fit, member
from doojax.learning.pushing import PushingData
from doojax.learning.runs import RunDirectory
from doojax.learning.vae import VaeProblem, size_of, varied
from doojax.models.vae import VaeConfig
from doojax.tasks.base import Task
from doojax.types import Verdict

PLACE_NOISE, MOVE_NOISE = 1e-3, 1e-4  # m, standard deviations
PROJECTED = {  # by the weights of the objective; a weight of 0 leaves a gradient out, its check still holds
    "augmentation": Weights(),
    "no_occupancy": Weights(occupancy=0.0),
    "no_distance": Weights(distance=0.0),
}
METHODS = ("none", *PROJECTED, "whole", "noise", "random", "vae")
ASIDE = 0.05  # m, either way along each axis: how far a whole scene is moved
VAE, VAE_STEPS = FitConfig(epochs=20, batch_size=32, checkpoint_every=5), 50  # an epoch's
VAE_WIDTH = 256  # of hidden layers and of the latent numbers; the thesis's have 1,000


@dataclass(frozen=True)
class PushingSet:
    """The trajectories of one seed."""

    folder: Path
    data: Dataset
    own: PushingData  # the trajectories as they were simulated
    number: int  # among the sets of a study


def made(
    method: str, sets: Sequence[PushingSet], task: Task, copies: int, seed: int, vaes: Any = None
) -> list[PushingData]:
    """What a method makes of each set: the trajectories themselves, and ``copies`` of each if it makes any.

    Args:
        method: one of METHODS.
        sets: of trajectories.
        task: whose they are.
        copies: tried for each trajectory; of those that are projected, the accepted ones count.
        seed: of everything that is random.
        vaes: for the method vae, what `learned_vaes` gave.
    """
    return [_made(method, one, task, copies, seed, vaes) for one in sets]


def _made(method: str, one: PushingSet, task: Task, copies: int, seed: int, vaes: Any) -> PushingData:
    if method == "none":
        return one.own
    if method in PROJECTED:
        return _projected(method, one, copies)
    key = stream(seed, "augmentation study", method, str(one.number))
    own = one.own
    repeated = jax.tree.map(lambda leaf: jnp.repeat(leaf, copies, axis=0), own)
    makers: dict[str, Callable[[], PushingData]] = {
        "whole": lambda: moved_whole(repeated, key),
        "noise": lambda: noisy(repeated, key),
        "random": lambda: _moved(one.data, task, copies, key),
        "vae": lambda: varied(member(vaes, one.number), repeated, jax.random.split(key, len(repeated))),
    }
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), own, makers[method]())


def learned_vaes(
    sets: Sequence[PushingSet], validation: PushingData, run: RunDirectory, report: Report, seed: int
) -> Any:
    """An autoencoder of each set, [sets]."""
    parts = [one.own for one in sets]
    counts = np.array([len(part) for part in parts])
    train = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    config = VaeConfig(size_of(train), VAE_WIDTH, VAE_WIDTH)
    problem = VaeProblem(train, validation, jnp.array(0), config, VAE_STEPS)
    members = (jnp.asarray(np.cumsum(counts) - counts), jnp.asarray(counts))
    return fit(problem, vae_fit(len(sets)), seed=seed, run=run, members=members, report=report)


def vae_fit(sets: int) -> FitConfig:
    """How the autoencoders of so many sets are trained."""
    return replace(VAE, members=sets)


def _projected(method: str, one: PushingSet, copies: int) -> PushingData:
    path = one.folder.with_name(f"{one.folder.name}_{method}")
    augment_dataset(
        one.folder,
        out=path,
        copies=copies,
        weights=PROJECTED[method],
        seed=2 * one.number + 1,  # data sets have even ones
    )
    augmented = Dataset.open(path)
    kept = np.flatnonzero(np.isin(augmented["verdict"][:], (Verdict.ORIGINAL, Verdict.ACCEPTED)))
    return PushingData.of(augmented.states(kept))


def moved_whole(data: PushingData, key: jax.Array) -> PushingData:
    """Each trajectory with all that stands there, turned by any angle and moved a little.

    Valid without a check: the table is the same everywhere and in all directions.
    """
    angle_key, way_key = jax.random.split(key)
    angle = jax.random.uniform(angle_key, (len(data),), minval=-jnp.pi, maxval=jnp.pi)
    way = jax.random.uniform(way_key, (len(data), 1, 1, 2), minval=-ASIDE, maxval=ASIDE)
    cosine, sine = (part(angle)[:, None, None] for part in (jnp.cos, jnp.sin))

    def turned(vectors: jax.Array) -> jax.Array:
        x, y = vectors[..., 0], vectors[..., 1]
        return jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)

    return PushingData(turned(data.places) + way, turned(data.moves))


def noisy(data: PushingData, key: jax.Array) -> PushingData:
    """Independent Gaussian noise on every place and every motion, as in the released code."""
    place_key, move_key = jax.random.split(key)
    return PushingData(
        data.places + PLACE_NOISE * jax.random.normal(place_key, data.places.shape),
        data.moves + MOVE_NOISE * jax.random.normal(move_key, data.moves.shape),
    )


def _moved(data: Dataset, task: Task, copies: int, key: jax.Array) -> PushingData:
    """What moves, moved by the transforms that augmentation draws, whatever it then goes through."""
    rows = np.repeat(np.arange(len(data)), copies)
    setting = setting_of(task, usual(task)[0])
    examples = Examples(
        states=data.states(rows),
        actions=jnp.asarray(data["actions"][rows]),
        obstacles=None,
        sound=jnp.ones(len(rows), dtype=bool),
    )
    targets = jax.vmap(lambda one: drawn(one, setting.bounds))(numbered(key, range(len(rows))))
    return PushingData.of(transformed(examples, setting, targets)[0])
