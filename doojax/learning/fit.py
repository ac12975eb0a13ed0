"""Train E networks at once on one problem, resumable to the same bits.

An epoch is one jitted call: it draws the batches, takes every step in a `jax.lax.scan`, validates, and keeps
each member's best weights. Its random keys come from the seed and the epoch's number, and the learning rate
from the steps that the optimiser has counted, so that a checkpoint holds all that a resumed run needs.

Learning that goes on while data come in trains again and again, each time from the models before (``begin``)
and on a `doojax.learning.buffer.Buffer` of a fixed size, so that only the first time compiles.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PyTree

from doojax.keys import stream
from doojax.learning.runs import RunDirectory

Report = Callable[[int, int, dict[str, np.ndarray]], None]
"""Told the number of an epoch, from 1, how many there are, and what was measured, arrays [E]."""


@dataclass(frozen=True)
class FitConfig:
    """How to train."""

    epochs: int
    batch_size: int
    members: int = 1  # networks, trained side by side from different seeds
    learning_rate: float = 1e-3  # of Adam
    schedule: Literal["constant", "cosine"] = "cosine"  # cosine: down to zero at the end of the last epoch
    patience: int = 0  # stop when no member's validation loss fell for so many epochs; 0: never
    keep: Literal["best", "last"] = "best"  # which epoch's weights: of the least validation loss, or the last
    checkpoint_every: int = 1  # epochs

    def __post_init__(self):
        """Refuse settings that train nothing."""
        for name in ("epochs", "batch_size", "members", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate is {self.learning_rate}, expected a positive number")

    def optimiser(self, steps: int) -> optax.GradientTransformation:
        """Adam at the learning rate of every step, of which an epoch has so many."""
        if self.schedule == "constant":
            return optax.adam(self.learning_rate)
        return optax.adam(optax.cosine_decay_schedule(self.learning_rate, self.epochs * steps))


@runtime_checkable
class Problem(Protocol):
    """What is to be learned: data, network and loss. An equinox module, so that its arrays are arguments.

    ``member`` is one member's slice of the settings that differ by member; None if nothing does.
    """

    def init(self, member: PyTree, *, key: Array) -> PyTree:
        """A fresh network."""
        ...

    def batches(self, member: PyTree, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Which examples each step of an epoch sees."""
        ...

    def loss(self, model: PyTree, rows: Int[Array, "batch"], member: PyTree) -> Float[Array, ""]:
        """The mean loss over a batch of training examples."""
        ...

    def validate(self, model: PyTree, member: PyTree) -> dict[str, Float[Array, ""]]:
        """Figures on the validation split, "loss" among them: the smaller, the better."""
        ...


class Progress(NamedTuple):
    """How far training has come, of one member or of E with a leading axis."""

    steps: Int[Array, "*E"]  # of the optimiser
    examples: Int[Array, "*E"]  # seen so far, each as often as it was


@runtime_checkable
class Scheduled(Protocol):
    """A `Problem` whose loss changes as training goes on."""

    def after(self, progress: Progress) -> Problem:
        """The problem as it is for a member that has come so far; its arrays have the same shapes."""
        ...


class FitState(eqx.Module):
    """All that training needs to go on, of one member or of E with a leading axis."""

    weights: PyTree  # the inexact arrays of the model
    optimiser: PyTree  # what Adam remembers
    best: PyTree  # the weights of the best epoch so far
    best_loss: Float[Array, "*E"]  # on the validation split
    stale: Int[Array, "*E"]  # epochs since the best
    progress: Progress


def fit(
    problem: Problem,
    config: FitConfig,
    *,
    seed: int,
    run: RunDirectory | None = None,
    members: PyTree = None,
    begin: PyTree = None,
    report: Report = lambda number, epochs, metrics: None,
) -> PyTree:
    """Train, and return the model with each member's best weights; its arrays have a leading axis E.

    Args:
        problem: what to learn; one that is `Scheduled` is told before each step how far training has come.
        config: how.
        seed: of everything that is random.
        run: where checkpoints and metrics go, and from where an interrupted run goes on; None: nowhere.
        members: settings that differ by member, arrays [E, ...].
        begin: models to begin with, as `fit` gave them, in place of fresh ones.
        report: called after each epoch.

    Raises:
        ValueError: if a loss is not finite; the last checkpoint is from before. Or for other models to begin
            with than the problem has.
    """
    key = stream(seed, "fit")
    state, static = start(problem, config, members, key=key, begin=begin)
    number, state = run.resume(state) if run else (0, state)
    while number < config.epochs and not exhausted(state, config):
        number += 1
        keys = jax.random.split(jax.random.fold_in(key, number), config.members)
        settings = (problem, static, members, keys, config)
        state, measured = epoch(settings, state)
        metrics = {name: np.asarray(values) for name, values in measured.items()}
        require_finite(metrics, number)
        if run:
            run.log({"epoch": number, **{name: values.tolist() for name, values in metrics.items()}})
        if run and (
            number % config.checkpoint_every == 0 or number == config.epochs or exhausted(state, config)
        ):
            run.save(number, state)
        report(number, config.epochs, metrics)
    return eqx.combine(state.best, static)


def member(models: PyTree, index: int) -> PyTree:
    """One of the models that `fit` gave."""
    return jax.tree.map(lambda leaf: leaf[index] if eqx.is_array(leaf) else leaf, models)


def start(
    problem: Problem, config: FitConfig, members: PyTree, *, key: Array, begin: PyTree = None
) -> tuple[FitState, PyTree]:
    """The state before the first epoch, and what of the model is not trained."""

    def init(member: PyTree, key: Array) -> PyTree:
        return problem.init(member, key=key)

    keys = jax.random.split(jax.random.fold_in(key, 0), config.members)
    models = eqx.filter_vmap(init)(members, keys)
    if begin is not None:
        expected, found = (jax.tree.map(jnp.shape, eqx.filter(one, eqx.is_array)) for one in (models, begin))
        if not eqx.tree_equal(expected, found):
            raise ValueError(
                f"the models to begin with do not fit: expected {config.members} members of the problem's "
                "own kind and sizes, as fit gave them"
            )
        models = jax.tree.map(lambda leaf: jnp.copy(leaf) if eqx.is_array(leaf) else leaf, begin)
    weights, static = eqx.partition(models, eqx.is_inexact_array)
    state = FitState(
        weights=weights,
        optimiser=jax.vmap(config.optimiser(1).init)(weights),
        best=jax.tree.map(jnp.copy, weights),
        best_loss=jnp.full(config.members, jnp.inf, dtype=float),  # not weakly typed: compiled once
        stale=jnp.zeros(config.members, dtype=jnp.int32),
        progress=Progress(*(jnp.zeros(config.members, dtype=jnp.int32) for _ in Progress._fields)),
    )
    return state, static


@eqx.filter_jit(donate="all-except-first")
def epoch(
    settings: tuple[Problem, PyTree, PyTree, Array, FitConfig], state: FitState
) -> tuple[FitState, dict[str, Float[Array, "E"]]]:
    """One pass over the batches and the validation split, for all members; they share nothing.

    On a GPU they train side by side (vmap); on a CPU, whose matrix products are faster one at a time than in
    a stack, one after the other (map).

    Args:
        settings: the problem, what of the model is not trained, the members' settings and keys, the config.
        state: before; its memory is given up.
    """
    problem, static, members, keys, config = settings

    def one(arguments: tuple[FitState, PyTree, Array]) -> tuple[FitState, dict[str, Array]]:
        state, member, key = arguments
        rows = problem.batches(member, config.batch_size, key=key)
        optimiser = config.optimiser(rows.shape[0])

        def loss(weights: PyTree, batch: Int[Array, "batch"], progress: Progress) -> Float[Array, ""]:
            return now(problem, progress).loss(eqx.combine(weights, static), batch, member)

        def step(carry: tuple[PyTree, PyTree, Progress], batch: Array):
            weights, memory, progress = carry
            value, gradient = jax.value_and_grad(loss)(weights, batch, progress)
            change, memory = optimiser.update(gradient, memory)
            progress = Progress(progress.steps + 1, progress.examples + batch.shape[0])
            return (optax.apply_updates(weights, change), memory, progress), value

        before = (state.weights, state.optimiser, state.progress)
        (weights, memory, progress), losses = jax.lax.scan(step, before, rows)
        measured = now(problem, progress).validate(eqx.combine(weights, static), member)
        better = (measured["loss"] < state.best_loss) | (config.keep == "last")
        after = FitState(
            weights=weights,
            optimiser=memory,
            best=jax.tree.map(lambda new, old: jnp.where(better, new, old), weights, state.best),
            best_loss=jnp.where(better, measured["loss"], state.best_loss),
            stale=jnp.where(better, 0, state.stale + 1),
            progress=progress,
        )
        named = {f"validation_{name}": value for name, value in measured.items()}
        return after, {"train_loss": losses.mean(), **named}

    if jax.default_backend() == "cpu":
        return jax.lax.map(one, (state, members, keys))
    return jax.vmap(one)((state, members, keys))


def now(problem: Problem, progress: Progress) -> Problem:
    """The problem as it is after so much training."""
    return problem.after(progress) if isinstance(problem, Scheduled) else problem


def exhausted(state: FitState, config: FitConfig) -> bool:
    """Has no member found better weights for too long?"""
    return config.patience > 0 and bool((state.stale >= config.patience).all())


def require_finite(metrics: dict[str, np.ndarray], number: int) -> None:
    """Raise a ValueError that names the members whose loss is not a number."""
    for name in ("train_loss", "validation_loss"):
        bad = np.flatnonzero(~np.isfinite(metrics[name]))
        if bad.size:
            raise ValueError(
                f"{name} of member {', '.join(map(str, bad))} is not finite in epoch {number}; lower the "
                "learning rate, or look for outliers in the data with doojax inspect"
            )


def shuffled(count: int, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
    """All of ``count`` examples in random order, but for those that do not fill a batch.

    Raises:
        ValueError: if they do not fill one.
    """
    if count < batch_size:
        raise ValueError(f"{count} examples do not fill a batch of {batch_size}; collect more data")
    steps = count // batch_size
    return jax.random.permutation(key, count)[: steps * batch_size].reshape(steps, batch_size)


def balanced(
    positive: Bool[Array, "n"], negative: Bool[Array, "n"], count: int, batch_size: int, *, key: Array
) -> Int[Array, "steps batch"]:
    """As many batches as ``count`` examples make, half of each from either class, drawn with replacement.

    Examples of neither class are never drawn. So the rarer class is oversampled, as the thesis does, and the
    commoner one is not cut down to it.
    """
    steps = max(1, count // batch_size)
    halves = (batch_size - batch_size // 2, batch_size // 2)
    rows = []
    for mask, half, half_key in zip((positive, negative), halves, jax.random.split(key), strict=True):
        ranks = jnp.cumsum(mask)
        drawn = jax.random.randint(half_key, (steps, half), 0, jnp.maximum(ranks[-1], 1))
        rows.append(jnp.searchsorted(ranks, drawn, side="right"))
    return jnp.concatenate(rows, axis=1)
