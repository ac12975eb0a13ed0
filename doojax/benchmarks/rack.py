"""The rack of the thesis's untangling scene, and MuJoCo's own check of the dual arm among it."""

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from doojax.robots import DUAL_ARM, dual_arm
from doojax.types import Obstacles

FLOOR = -0.445  # m
# centre and half extents, m; the robot's base is at the origin and y points into the rack
BOXES = (
    ((0, 0.76, -0.415), (0.40, 0.29, 0.03)),
    ((0, 0.76, 0.085), (0.40, 0.25, 0.03)),
    ((0, 0.76, 0.535), (0.42, 0.29, 0.05)),
    *(((x, y, z), (0.04, 0.04, 0.25)) for x in (-0.38, 0.38) for y in (0.51, 1.01) for z in (-0.165, 0.335)),
    ((-0.2, 0.62, 0.185), (0.14, 0.04, 0.10)),
    ((0, 0.64, 0.785), (0.10, 0.15, 0.20)),
    ((-0.04, 0.49, 0.835), (0.01, 0.01, 0.01)),
    ((-0.70, 0, 0.53), (0.01, 2.5, 1.0)),
    ((0, 1.36, 0.53), (2.5, 0.01, 1.0)),
)


def rack() -> Obstacles:
    """The boxes."""
    centre, half = (jnp.array(values, float) for values in zip(*BOXES, strict=True))
    upright = jnp.tile(jnp.array([1.0, 0, 0, 0]), (len(BOXES), 1))
    return Obstacles(jnp.zeros(len(BOXES), int), centre, upright, half, jnp.ones(len(BOXES), bool))


class MujocoCheck:
    """Whether the dual arm touches the rack, the floor or itself, by MuJoCo's collision detection."""

    def __init__(self):
        """Compile a model in which bodies that may touch are excluded."""
        robot = dual_arm()
        spec = mujoco.MjSpec.from_file(str(DUAL_ARM))
        for centre, half in BOXES:
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=half)
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(type=plane, pos=[0, 0, FLOOR], size=[5, 5, 0.1])
        plain = spec.compile()
        carried = [geom for geom in range(plain.ngeom) if plain.geom_bodyid[geom]]
        bodies = plain.geom_bodyid
        self._pairs = {(carried[i], carried[j]) for i, j in robot.pairs}
        touching = {(bodies[i], bodies[j]) for i, j in self._pairs}
        names = [plain.body(body).name for body in range(plain.nbody)]
        for one in range(1, plain.nbody):
            for other in range(one + 1, plain.nbody):
                if (one, other) not in touching and (other, one) not in touching:
                    spec.add_exclude(bodyname1=names[one], bodyname2=names[other])
        stand = plain.geom("stand").id
        on_base = zip(carried, robot.capsule_links, strict=True)
        self._ignored = {(stand, geom) for geom, link in on_base if robot.parents[link] < 0}
        self._bodies = bodies
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.count = 0

    def is_free(self, joints: Float[np.ndarray, "20"]) -> bool:
        """True without a contact of bodies that must not touch."""
        self.count += 1
        data = self.data
        data.qpos[:] = joints
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_collision(self.model, data)
        if not data.ncon:
            return True
        return not any(self._counts(*pair) for pair in data.contact.geom.tolist())

    def _counts(self, one: int, other: int) -> bool:
        one, other = min(one, other), max(one, other)
        if self._bodies[one] and self._bodies[other]:
            return (one, other) in self._pairs
        return (one, other) not in self._ignored
