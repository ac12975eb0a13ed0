"""What the methods of chapter II are made of, by name."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """What a method is made of: kinds of learned models, or the names of what is not learned."""

    dynamics: str
    reliability: str = "always"
    recovery: str | None = None
    policy: str | None = None  # acts on what it sees: nothing is planned


RECIPES: Mapping[str, Recipe] = {
    "classifier": Recipe("dynamics", "classifier"),
    "voxel_classifier": Recipe("dynamics", "voxel_classifier"),
    "deviation": Recipe("dynamics", "deviation"),
    "no_classifier": Recipe("dynamics"),
    "collision_checker": Recipe("dynamics", "collision_checker"),
    "full_dynamics": Recipe("full_dynamics"),
    "learned_recovery": Recipe("dynamics", "classifier", "recovery"),
    "random_recovery": Recipe("dynamics", "classifier", "random"),
    "oracle": Recipe("simulator"),
    "policy": Recipe("simulator", policy="policy"),
}
