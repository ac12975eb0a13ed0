"""An augmentation of a data set again, step by step: where its projection looked."""

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.augmentation.examples import Bounds, Setting, problem_of
from doojax.augmentation.objectives import Weights, any_transform
from doojax.augmentation.projection import ProjectionConfig, Term, projection_path
from doojax.augmentation.settings import setting_of, usual
from doojax.datasets.store import Dataset
from doojax.geometry.motion import RigidMotion
from doojax.learning.checkpoints import load_model
from doojax.tasks.ropes import task_of
from doojax.types import Verdict


@dataclass(frozen=True)
class Replayed:
    """One augmentation's projection; the first transform moves nothing, the last is the end of the search."""

    original: int  # index of the row that was moved
    transforms: Float[np.ndarray, "S 6"]  # translation (m), rotation vector (rad)
    centre: Float[np.ndarray, "3"]  # m, what they turn about
    bodies: Float[np.ndarray, "S T1 K 3"]  # m, of the original, at each transform; hands last
    passive: int  # how many of them are no hands

    def places(self, step: int) -> tuple[Float[np.ndarray, "T1 N 3"], Float[np.ndarray, "T1 G 3"]]:
        """Where the original's points, or bodies, and its hands are at a step of the search, m."""
        points, hands = np.split(self.bodies[step], [self.passive], axis=1)
        return points, hands


def original_of(dataset: Dataset, index: int) -> int:
    """The index of the row that augmentation ``index`` was made of.

    Raises:
        ValueError: where that row's shard is not there.
    """
    same = (dataset["original"][:] == dataset["original"][index]) & (
        dataset["first_period"][:] == dataset["first_period"][index]
    )
    found = np.flatnonzero(same & (dataset["verdict"][:] == Verdict.ORIGINAL))
    if not found.size:
        raise ValueError(f"{dataset.path} does not hold the original of row {dataset.rows[index]}")
    return int(found[0])


def replayed(dataset: Dataset, index: int) -> Replayed:
    """Search again for the augmentation in row ``index`` of an augmented data set.

    Raises:
        FileNotFoundError: for a validity that was used and is not there any more.
        ValueError: for an original.
    """
    if dataset["verdict"][index] == Verdict.ORIGINAL:
        raise ValueError(f"row {dataset.rows[index]} is an original: nothing was searched for")
    original, config = original_of(dataset, index), dataset.config["augmentation"]
    task = task_of(dataset.config)
    projection = replace(usual(task)[1], distance_tolerance=config["distance_tolerance"])
    setting = setting_of(task, Bounds(tuple(config["translation"]), tuple(config["rotation"])))
    validity = load_model(config["validity"])[0] if "validity" in config else any_transform
    states = jax.tree.map(lambda leaf: leaf[0], dataset.states([original]))
    found = _searched(
        setting,
        states,
        jax.tree.map(lambda leaf: leaf[0], dataset.obstacles([original])) if task.scene.obstacles else None,
        jnp.asarray(dataset["target"][index]),
        projection,
        Weights(**config["weights"]),
        validity,
    )
    transforms, takes, centre, bodies = (np.asarray(one) for one in found)
    steps = 1 + int(takes)
    return Replayed(original, transforms[:steps], centre, bodies[:steps], states.passive)


@eqx.filter_jit
def _searched(
    setting: Setting,
    states: Any,
    obstacles: Any,
    target: Float[Array, "6"],
    config: ProjectionConfig,
    weights: Weights,
    validity: Term,
) -> tuple[Array, Array, Array, Array]:
    problem = problem_of(setting, setting.movable(states, obstacles))
    path, takes = projection_path(problem, target, config, weights, validity)
    transforms = jnp.concatenate([jnp.zeros((1, 6), path.dtype), path])
    motions = jax.vmap(RigidMotion.of, (0, None))(transforms, problem.centre)
    bodies = jax.vmap(lambda motion: setting.moved(states, motion).bodies())(motions)
    return transforms, takes, problem.centre, bodies
