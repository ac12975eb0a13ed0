"""Scenes small enough to compile in seconds."""

import jax.numpy as jnp

from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, Shape, parked_poses
from doojax.simulation.state import SimState
from doojax.tasks.starts import straight_qpos
from doojax.types import ShapeKind


def planar_scene(substeps: int = 200, **changes) -> Scene:
    settings = {
        "name": "small",
        "rope_model": RopeModel("planar_chain", 4),
        "rope": RopeParameters(0.2, 0.02, 0.2, bending_stiffness=1e-3, bending_damping=1e-3, friction=0.1),
        "grippers": (Gripper(link=3, end=1, radius=0.02, max_force=10.0, max_speed=0.18),),
        "obstacles": (Obstacle("cube", (Shape(ShapeKind.BOX, (0.05, 0.05, 0.05)),)),),
        "timestep": 0.005,
        "substeps": substeps,
    }
    return Scene(**(settings | changes))


def clamped_scene(links: int, stiffness: float, kind: str = "capsule_chain") -> Scene:
    """A rope of 0.5 m and 50 g held rigidly by the middle of link 0, in one-second control periods."""
    rope = RopeParameters(
        0.5,
        0.005,
        0.05,
        bending_stiffness=stiffness,
        twisting_stiffness=stiffness,
        bending_damping=0.3 * stiffness,
    )
    clamp = Gripper(
        link=0, end=0, radius=0.01, max_force=5e4, max_speed=1.0, inertia=1e3, stiffness=2.5e6, hold="rigid"
    )
    return Scene("clamped", RopeModel(kind, links), rope, (clamp,), floor=False, timestep=0.004, substeps=250)


def no_start(key):
    raise AssertionError("these tests make their own starts")


def straight_states(scene: Scene, batch: int, height: float = 1.0) -> SimState:
    position, quaternion = parked_poses(len(scene.obstacles))
    return SimState(
        qpos=jnp.tile(jnp.asarray(straight_qpos(scene, height), dtype=jnp.float32), (batch, 1)),
        qvel=jnp.zeros((batch, scene.nv)),
        obstacle_position=jnp.tile(position, (batch, 1, 1)),
        obstacle_quaternion=jnp.tile(quaternion, (batch, 1, 1)),
        holding=jnp.ones((batch, len(scene.grippers)), dtype=bool),
        faults=jnp.zeros(batch, dtype=jnp.int32),
        model_fields={},
    )
