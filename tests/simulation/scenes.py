"""Scenes small enough to compile in seconds."""

import numpy as np

from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, Shape, SolverSettings
from doojax.simulation.state import SimState
from doojax.tasks.starts import resting, straight_qpos
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
        "solver": SolverSettings(cone="pyramidal"),  # as rope_dragging has; MJX compiles it sooner
    }
    return Scene(**(settings | changes))


def no_start(key):
    raise AssertionError("these tests make their own starts")


def straight_states(scene: Scene, batch: int, height: float = 1.0) -> SimState:
    return resting(scene, np.tile(straight_qpos(scene, height), (batch, 1)))
