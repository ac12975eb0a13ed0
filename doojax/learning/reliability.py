"""Learning to tell which predictions are right: balanced batches of labelled transitions (thesis 2.3.4)."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from doojax.learning.fit import balanced
from doojax.learning.labels import Examples
from doojax.types import Obstacles

AT_ONCE = 512  # examples judged side by side
FEWEST = 20  # examples of a class


class ClassifierProblem(eqx.Module):
    """Fit a classifier; each member has its own threshold of the error, metres."""

    train: Examples
    train_obstacles: Obstacles  # [K], of the trajectories
    validation: Examples
    validation_obstacles: Obstacles
    network: Any = eqx.field(static=True)  # DistanceClassifier, or another with `logit`
    config: Any = eqx.field(static=True)

    def init(self, member: Float[Array, ""], *, key: Array) -> Any:
        """A fresh network."""
        return self.network(self.config, key=key)

    def batches(self, member: Float[Array, ""], batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Half right, half wrong, of those that begin where the prediction was still right."""
        kept, right = self.train.kept(member), self.train.right(member)
        return balanced(kept & right, kept & ~right, len(self.train), batch_size, key=key)

    def loss(self, model: Any, rows: Int[Array, "batch"], member: Float[Array, ""]) -> Float[Array, ""]:
        """Binary cross-entropy."""
        logits = jax.vmap(lambda row: judged_one(model.logit, self.train, self.train_obstacles, row))(rows)
        return cross_entropy(logits, self.train.right(member)[rows]).mean()

    def validate(self, model: Any, member: Float[Array, ""]) -> dict[str, Float[Array, ""]]:
        """Cross-entropy and accuracy, both with the two classes weighing alike."""
        logits = judged(model.logit, self.validation, self.validation_obstacles)
        kept, right = self.validation.kept(member), self.validation.right(member)
        weight = kept * jnp.where(right, 1 / (kept & right).sum(), 1 / (kept & ~right).sum()) / 2
        return {
            "loss": (weight * cross_entropy(logits, right)).sum(),
            "balanced_accuracy": (weight * ((logits > 0) == right)).sum(),
        }


def cross_entropy(logits: Float[Array, "*b"], right: Array) -> Float[Array, "*b"]:
    """Of each logit with a label or a probability, in nats."""
    return jnp.logaddexp(0.0, logits) - logits * right


def judged_one(
    judge: Callable[..., Any], examples: Examples, obstacles: Obstacles, row: Int[Array, ""]
) -> Any:
    """What ``judge``, called as a `Reliability` is, says of one example."""
    one, number = jax.tree.map(lambda leaf: leaf[row], (examples.transition, examples.trajectory))
    scene = jax.tree.map(lambda leaf: leaf[number], obstacles)
    return judge(scene, one)


@eqx.filter_jit
def judged(judge: Callable[..., Any], examples: Examples, obstacles: Obstacles) -> Any:
    """`judged_one` of all examples, some at a time."""
    return jax.lax.map(
        lambda row: judged_one(judge, examples, obstacles, row),
        jnp.arange(len(examples)),
        batch_size=min(AT_ONCE, len(examples)),
    )


def judged_kept(
    judge: Callable[..., Any], examples: Examples, obstacles: Obstacles, threshold: float
) -> tuple[Any, Bool[np.ndarray, "k"]]:
    """What ``judge`` says of the examples that count at a threshold (m) of the error, and are they right."""
    kept = np.asarray(examples.kept(threshold))
    found = jax.tree.map(lambda leaf: np.asarray(leaf)[kept], judged(judge, examples, obstacles))
    return found, np.asarray(examples.right(threshold))[kept]


def require_both_classes(examples: Examples, threshold: float, split: str) -> None:
    """Raise a ValueError where a split has too few examples of a class to learn from or to measure by."""
    kept, right = np.asarray(examples.kept(threshold)), np.asarray(examples.right(threshold))
    for name, count in (("right", (kept & right).sum()), ("wrong", (kept & ~right).sum())):
        if count < FEWEST:
            raise ValueError(
                f"the {split} split has {count} {name} predictions at a threshold of {threshold:.4g} m, "
                f"expected at least {FEWEST}: collect more data, in scenes where both occur, or choose "
                "another threshold"
            )
