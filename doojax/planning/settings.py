"""How a tree is grown: the numbers that a user may choose."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

LEAST_MARGIN = 0.2  # of a goal's tolerance, to which the spread may narrow it
# Beyond these, arrays would not fit into any memory.
MOST = {"lanes": 16_384, "extensions": 4_000_000, "duration": 10_000, "candidates": 4096}
MOST |= {"stuck_after": 4_000_000, "shortcuts": 1000}


@dataclass(frozen=True)
class RrtSettings:
    """How a tree is grown."""

    lanes: int = 64  # extensions tried at once
    extensions: int = 8192  # attempts before the search is given up
    goal_bias: float = 0.3  # probability that a lane heads for the goal
    duration: int = 20  # an action is held for up to this many steps, uniformly
    candidates: int = 32  # actions drawn for a lane; the one that best moves the grippers towards the sample
    random_accept: float = 0.0  # probability that a rejected extension is accepted nevertheless
    stuck_after: int = 32  # attempts without a single success after which the start counts as stuck
    goal_margin: float = 0.6
    """Of the goal's tolerance: a plan is to end so near, because execution errs; nearer, down to a fifth,
    where the predicted spread of its end leaves no more of the tolerance."""
    shortcuts: int = 2  # rounds of as many shortcuts as lanes, tried on a plan that reaches the goal

    def __post_init__(self):
        """Refuse what plans nothing."""
        for name, most in MOST.items():
            least = 0 if name == "shortcuts" else 1
            if not least <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}, expected {least} to {most:,}")
        for name in ("goal_bias", "random_accept", "goal_margin"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 to 1")

    def reach(self, tolerance: Float[Array, ""], spread: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """How near to a goal (m) a prediction must be so that it is reached, two spreads (m) off, too."""
        most = self.goal_margin * tolerance
        return jnp.clip(tolerance - 2 * spread, jnp.minimum(LEAST_MARGIN * tolerance, most), most)

    @property
    def expansions(self) -> int:
        """Calls after which the budget is spent."""
        return -(-self.extensions // self.lanes)
