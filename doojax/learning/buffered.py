"""Learning to tell which predictions are right while data come in: from a buffer, a fixed number of steps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from doojax.learning.buffer import Buffer, weighted
from doojax.learning.reliability import AT_ONCE, cross_entropy
from doojax.types import Obstacles, Transition

MEASURED = 2048  # examples


class Labelled(eqx.Module):
    """n predicted transitions, each with its scene and whether it was right."""

    transition: Transition  # [n]
    obstacles: Obstacles  # [n, M]
    right: Bool[Array, "*n"]


class BufferedClassifier(eqx.Module):
    """Fit a classifier to a buffer of `Labelled`; a `doojax.learning.fit.Problem`.

    Both classes count alike; where there is but one yet, its examples are all that is seen.
    """

    buffer: Buffer
    steps: int = eqx.field(static=True)  # of an epoch, however many examples there are
    network: Any = eqx.field(static=True)  # DistanceClassifier, or another with `logit`
    config: Any = eqx.field(static=True)

    def init(self, member: PyTree, *, key: Array) -> Any:
        """A fresh network."""
        return self.network(self.config, key=key)

    def batches(self, member: PyTree, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Half right, half wrong, drawn with replacement."""
        weight = class_weights(self.buffer.weight, self.buffer.items.right)
        return weighted(weight, self.steps, batch_size, key=key)

    def loss(self, model: Any, rows: Int[Array, "batch"], member: PyTree) -> Float[Array, ""]:
        """Binary cross-entropy."""
        chosen = jax.tree.map(lambda leaf: leaf[rows], self.buffer.items)
        logits = jax.vmap(model.logit)(chosen.obstacles, chosen.transition)
        return cross_entropy(logits, chosen.right).mean()

    def validate(self, model: Any, member: PyTree) -> dict[str, Float[Array, ""]]:
        """Cross-entropy and accuracy on examples from all over the buffer, classes weighing alike."""
        rows = evenly(class_weights(self.buffer.weight, self.buffer.items.right), MEASURED)
        some: Labelled = jax.tree.map(lambda leaf: leaf[rows], self.buffer.items)
        logits = jax.lax.map(lambda one: model.logit(one.obstacles, one.transition), some, batch_size=AT_ONCE)
        return {
            "loss": cross_entropy(logits, some.right).mean(),
            "balanced_accuracy": ((logits > 0) == some.right).mean(),
        }


def evenly(weight: Float[Array, "n"], count: int) -> Int[Array, "{count}"]:
    """Numbers of examples, each as often as its share of the weights says, without chance."""
    total = jnp.cumsum(weight)
    places = total[-1] * (jnp.arange(count) + 0.5) / count
    return jnp.minimum(jnp.searchsorted(total, places, side="right"), len(weight) - 1)


def class_weights(weight: Float[Array, "n"], right: Bool[Array, "n"]) -> Float[Array, "n"]:
    """Weights by which both classes are drawn as often; a class that is alone has all."""
    rights, wrongs = (weight * right).sum(), (weight * ~right).sum()
    of_class = jnp.where(right, rights, wrongs)
    return jnp.where(of_class > 0, weight / jnp.where(of_class > 0, of_class, 1.0), 0.0)
