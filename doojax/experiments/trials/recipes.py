"""What the methods of chapters II and IV are made of, by name."""

from collections.abc import Mapping
from dataclasses import dataclass

NOT_LEARNED = {"simulator", "always", "collision_checker", "random", None}


@dataclass(frozen=True)
class Recipe:
    """What a method is made of: kinds of learned models, or the names of what is not learned."""

    dynamics: str
    reliability: str = "always"
    recovery: str | None = None
    policy: str | None = None  # acts on what it sees: nothing is planned
    folder: str | None = None  # in that of the models, where the learned ones are

    @property
    def names(self) -> dict[str, str]:
        """The kinds of the learned models, and the name of each among those that `find_models` finds."""
        kinds = {self.dynamics, self.reliability, self.recovery, self.policy} - NOT_LEARNED
        folder = f"{self.folder}/" if self.folder else ""
        return {kind: folder + kind for kind in sorted(kind for kind in kinds if kind)}


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
    # dynamics that were adapted to the data of another place, see `doojax watering-study`
    "focus": Recipe("dynamics", "deviation", folder="focus"),
    "all_data": Recipe("dynamics", "deviation", folder="all_data"),
    "all_data_no_mde": Recipe("dynamics", folder="all_data"),
    "no_adaptation": Recipe("dynamics", folder="source"),
}
