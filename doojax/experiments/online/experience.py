"""What trials taught: executed trajectories, and predicted transitions that turned out right or wrong."""

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from doojax.augmentation.examples import Examples, Setting, augment
from doojax.augmentation.projection import ProjectionConfig
from doojax.experiments.trials.records import TrialRecord
from doojax.learning.buffer import weighted
from doojax.learning.buffered import Labelled, class_weights
from doojax.learning.data import Trajectories
from doojax.learning.labels import LabelConfig, label
from doojax.models.protocols import Dynamics
from doojax.types import RopeState, Verdict

NOISE = 0.005  # m, standard deviation of the noise in place of augmentation; the released code's for ropes
Enrichment = Literal["none", "augmentation", "noise"]


def trajectory_of(record: TrialRecord) -> Trajectories | None:
    """What a trial executed, as one trajectory of a rope; None where nothing was.

    What followed a simulation that broke down is left out.
    """
    states = [np.asarray(record.points, np.float32), np.asarray(record.grippers, np.float32)]
    finite = np.isfinite(states[0]).all((1, 2)) & np.isfinite(states[1]).all((1, 2))
    sound = len(finite) if finite.all() else int(np.argmin(finite))
    if sound < 2:
        return None
    points, grippers = (leaf[None, :sound] for leaf in states)
    actions = np.asarray(record.replay["actions"], np.float32)[None, : sound - 1]
    obstacles = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], record.obstacles)
    return Trajectories(
        states=RopeState(jnp.asarray(points), jnp.asarray(grippers)),
        actions=jnp.asarray(actions),
        obstacles=obstacles,
        rows=jnp.zeros(1, dtype=jnp.int32),
    )


def padded(trajectory: Trajectories, steps: int) -> Trajectories:
    """A trajectory with so many actions: what is missing at its end are NaN and actions of zero."""
    missing = steps - trajectory.actions.shape[1]

    def fill(leaf: Array, value: float) -> Array:
        return jnp.pad(leaf, [(0, 0), (0, missing)] + [(0, 0)] * (leaf.ndim - 2), constant_values=value)

    return Trajectories(
        states=jax.tree.map(lambda leaf: fill(leaf, jnp.nan), trajectory.states),
        actions=fill(trajectory.actions, 0.0),
        obstacles=trajectory.obstacles,
        rows=trajectory.rows,
    )


def judged_by_outcome(
    dynamics: Dynamics, trajectory: Trajectories, threshold: float, config: LabelConfig, steps: int
) -> tuple[Labelled, Bool[np.ndarray, "n"]]:
    """Transitions that the dynamics predict along what was executed, and which of them count.

    Args:
        dynamics: whose predictions are judged.
        trajectory: one, of at most ``steps`` actions.
        threshold: of the error (m) below which a prediction is right.
        config: from which states, and for how long, is predicted.
        steps: so that the shapes of the result depend on no trial.
    """
    found = label(dynamics, padded(trajectory, steps), config)
    keep = np.asarray(found.kept(threshold)) & np.isfinite(np.asarray(found.error))

    def known(leaf: Array) -> Array:  # NaN would stay NaN, times a weight of zero, too
        return jnp.where(keep.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0)

    count = len(found)
    obstacles = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf[0], (count, *leaf.shape[1:])), trajectory.obstacles
    )
    return Labelled(jax.tree.map(known, found.transition), obstacles, found.right(threshold)), keep


def enriched(
    kind: Enrichment,
    key: Array,
    labelled: Labelled,
    keep: Bool[np.ndarray, "n"],
    setting: Setting,
    config: ProjectionConfig,
    attempts: int,
) -> tuple[Labelled, Bool[np.ndarray, "attempts"]]:
    """Other examples with the same labels, made from some, and which of them are valid.

    Half of what they are made from was right and half wrong, if there are both.

    Args:
        kind: augmentation (moved rigidly to where the same touches) or noise (Gaussian, on every place).
        key: of all that is random.
        labelled: n examples.
        keep: which of them count, at least one.
        setting: of augmentations.
        config: of augmentations.
        attempts: how many are made.
    """
    draw_key, own_key = jax.random.split(key)
    weight = class_weights(jnp.asarray(keep, jnp.float32), labelled.right)
    rows = weighted(weight, 1, attempts, key=draw_key)[0]
    chosen: Labelled = jax.tree.map(lambda leaf: leaf[rows], labelled)
    transition = chosen.transition
    if kind == "noise":
        before, after = (
            _noisy(one, key)
            for one, key in zip(
                (transition.state, transition.next_state), jax.random.split(own_key), strict=True
            )
        )
        # a hand is sent to a place, and that is noisy, too
        shift = transition.state.grippers - before.grippers
        sent = NOISE * jax.random.normal(jax.random.fold_in(own_key, 2), transition.action.shape)
        moved = type(transition)(before, transition.action + shift + sent, after, transition.uncertainty)
        return Labelled(moved, chosen.obstacles, chosen.right), np.ones(attempts, dtype=bool)
    states = jax.tree.map(lambda *pair: jnp.stack(pair, 1), transition.state, transition.next_state)
    sound = jnp.ones(attempts, dtype=bool)
    examples = Examples(states, transition.action[:, None], chosen.obstacles, sound)
    found = augment(jax.random.split(own_key, attempts), examples, setting, config)
    accepted = np.asarray(found.verdict == Verdict.ACCEPTED)

    def known(leaf: Array, time: int) -> Array:
        return jnp.where(accepted.reshape(-1, *[1] * (leaf.ndim - 2)), leaf[:, time], 0)

    begin, end = (jax.tree.map(lambda leaf, t=t: known(leaf, t), found.states) for t in (0, 1))
    moved = type(transition)(begin, known(found.actions, 0), end, transition.uncertainty)
    return Labelled(moved, chosen.obstacles, chosen.right), accepted


def _noisy(state: RopeState, key: Array) -> RopeState:
    points_key, grippers_key = jax.random.split(key)
    return RopeState(
        state.points + NOISE * jax.random.normal(points_key, state.points.shape),
        state.grippers + NOISE * jax.random.normal(grippers_key, state.grippers.shape),
    )


def executed(records: Sequence[TrialRecord]) -> list[Trajectories]:
    """What trials executed, of those that executed anything."""
    found = [trajectory_of(record) for record in records]
    return [one for one in found if one is not None]
