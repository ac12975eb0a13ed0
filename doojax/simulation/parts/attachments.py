"""Ropes that are fastened to obstacles."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco

from doojax.simulation.parts.base import Part
from doojax.simulation.rope import link_name

if TYPE_CHECKING:
    from doojax.simulation.scenes import Attachment, Scene


@dataclass(frozen=True)
class Attachments(Part):
    """Equalities between the origins of obstacles and points of the rope, always active."""

    attachments: "tuple[Attachment, ...]"

    def add(self, spec: mujoco.MjSpec, scene: "Scene") -> None:
        """Add sites and equalities."""
        half = scene.rope_part.parameters.length / scene.links / 2
        for index, one in enumerate(self.attachments):
            places = {one.obstacle: 0.0, link_name(one.link): one.end * half}
            for body, x in places.items():
                spec.body(body).add_site(name=f"attachment{index}_{body}", pos=[x, 0, 0])
            equality = spec.add_equality(
                name=f"attachment{index}", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE
            )
            equality.name1, equality.name2 = (f"attachment{index}_{body}" for body in places)
