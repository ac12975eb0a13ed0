"""What a sample costs whose rollouts differ, such as those of ropes that are known only roughly."""

from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float


@dataclass(frozen=True)
class Risk:
    """Of the costs of R rollouts: their mean, the worst, or the mean of the worst ones (CVaR)."""

    kind: Literal["mean", "worst", "cvar"] = "mean"
    tail: float = 0.25  # the share of rollouts that CVaR looks at

    def __post_init__(self):
        """Refuse a tail that is none."""
        if self.kind not in ("mean", "worst", "cvar"):
            raise ValueError(f"risk is {self.kind!r}, expected mean, worst or cvar")
        if not 0 < self.tail <= 1:
            raise ValueError(f"tail is {self.tail}, expected a share: more than 0, at most 1")

    def of(self, costs: Float[Array, "*b R"]) -> Float[Array, "*b"]:
        """One cost for each R of them; of a tail that is no whole number the last counts in part."""
        if self.kind == "mean":
            return costs.mean(-1)
        if self.kind == "worst":
            return costs.max(-1)
        count = costs.shape[-1]
        share = jnp.clip(self.tail * count - jnp.arange(count), 0, 1)
        return (jnp.sort(costs, axis=-1)[..., ::-1] * share).sum(-1) / (self.tail * count)
