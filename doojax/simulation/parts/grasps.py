"""Holds of any hand on any place of the rope, which data switch on and off and move along it.

There is an equality for each hand and link, of which at most one a hand is active. In MuJoCo C one that is
not active costs nothing; in MJX each is three rows of the constraints, active or not, six where holds are
rigid.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import mujoco
import numpy as np

from doojax.simulation.parts.base import Part, Places
from doojax.simulation.rope import link_name

if TYPE_CHECKING:
    from doojax.simulation.scenes import Scene

# Of a rigid hold, m/rad: an angle counts as much as so many metres. As in the thesis's threading.
TORQUE_SCALE = 0.1


@dataclass(frozen=True)
class Grasps(Part):
    """Of hands, by the names of their bodies, on a rope of so many links."""

    hands: tuple[str, ...]
    anchors: tuple[tuple[float, float, float], ...]  # where on those bodies, m
    links: int
    hold: Literal["point", "rigid"] = "point"

    def add(self, spec: mujoco.MjSpec, scene: "Scene") -> None:
        """Add an inactive equality for each hand and link."""
        for name, (hand, link) in zip(self._names(), self._pairs(), strict=True):
            rigid = self.hold == "rigid"
            kind = mujoco.mjtEq.mjEQ_WELD if rigid else mujoco.mjtEq.mjEQ_CONNECT
            equality = spec.add_equality(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_BODY)
            data, anchor = (
                np.zeros_like(equality.data),
                dict(zip(self.hands, self.anchors, strict=True))[hand],
            )
            if rigid:  # on the link, on the hand, how they are turned, and the torque's scale
                data[3:6], data[6:10], data[10] = anchor, (1, 0, 0, 0), TORQUE_SCALE
            else:  # on the hand, on the link
                data[:3] = anchor
            equality.data = data
            equality.name1, equality.name2, equality.active = hand, link_name(link), False

    def find(self, model: mujoco.MjModel) -> Places:
        """``holds`` are those of the first hand, a link each, then those of the next."""
        return Places(holds=np.array([model.equality(name).id for name in self._names()], dtype=int))

    def _pairs(self) -> list[tuple[str, int]]:
        return [(hand, link) for hand in self.hands for link in range(self.links)]

    def _names(self) -> list[str]:
        return [f"{hand}_grasp{link}" for hand, link in self._pairs()]
