"""Obstacles at random, and the distances that MuJoCo gives."""

import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from doojax.types import Obstacles, ShapeKind

KINDS = [ShapeKind.BOX, ShapeKind.CAPSULE, ShapeKind.CYLINDER] * 3
MUJOCO_KINDS = {
    ShapeKind.BOX: mujoco.mjtGeom.mjGEOM_BOX,
    ShapeKind.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    ShapeKind.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}


def random_obstacles(rng, kinds=KINDS):
    half_size = rng.uniform(0.02, 0.3, (len(kinds), 3))
    round_shape = np.array(kinds) != ShapeKind.BOX
    half_size[round_shape, 1] = half_size[round_shape, 0]
    return obstacles_of(
        kinds,
        rng.uniform(-0.6, 0.6, (len(kinds), 3)),
        Rotation.random(len(kinds), rng=rng).as_quat(scalar_first=True),
        half_size,
    )


def obstacles_of(kinds, centre, quaternion, half_size):
    return Obstacles(
        kind=jnp.array(kinds, int),
        centre=jnp.asarray(centre, float),
        quaternion=jnp.asarray(quaternion, float),
        half_size=jnp.asarray(half_size, float),
        active=jnp.ones(len(kinds), bool),
    )


def one_shape(kind, half_size):
    return obstacles_of([kind], [[0, 0, 0]], [[1, 0, 0, 0]], [half_size])


def in_mujoco(obstacles, probe, probe_size):
    """A model with the obstacles and a probe geom; returns distances(position, quaternion) -> [M]."""
    spec = mujoco.MjSpec()
    for i in range(len(obstacles.kind)):
        kind = ShapeKind(int(obstacles.kind[i]))
        size = np.asarray(obstacles.half_size[i], float)
        spec.worldbody.add_geom(
            type=MUJOCO_KINDS[kind],
            size=size if kind == ShapeKind.BOX else [size[0], size[2], 0],
            pos=obstacles.centre[i],
            quat=obstacles.quaternion[i],
        )
    body = spec.worldbody.add_body(mocap=True)
    body.add_geom(type=MUJOCO_KINDS[probe], size=probe_size)
    model = spec.compile()
    data = mujoco.MjData(model)

    def distances_at(position, quaternion=(1, 0, 0, 0)):
        data.mocap_pos[0], data.mocap_quat[0] = position, quaternion
        mujoco.mj_forward(model, data)
        last = model.ngeom - 1
        return [mujoco.mj_geomDistance(model, data, i, last, 10, None) for i in range(last)]

    return distances_at
