"""A light scene: a short rope hangs before the robot, and nothing is in the way."""

import jax.numpy as jnp
import numpy as np

from doojax.simulation.grasps import graspable
from doojax.simulation.laying import laid
from doojax.simulation.rope import RopeParameters
from doojax.simulation.scenes import Obstacle
from doojax.simulation.state import at_rest
from doojax.tasks.arms import ArmTask, Start, armed_scene, box, joint_addresses

LINKS, LENGTH = 6, 0.6
HOOK, GOAL = (0.1, 0.62, 1.1), (-0.05, 0.62, 0.75)
SCENE = armed_scene(
    "hanging",
    LINKS,
    RopeParameters(LENGTH, 0.01, 0.2, bending_stiffness=2e-3, bending_damping=2e-3),
    (Obstacle("attach", ()), box("shelf", 0.05, 0.05, 0.05)),
)


def draw(task, rng):
    raise NotImplementedError


def no_loops(centres):
    return {}


TASK = ArmTask("hanging", SCENE, 1.0, 0.05, 20, draw, no_loops)


def start() -> Start:
    """The rope hangs straight down."""
    qpos = np.zeros(SCENE.nq)
    qpos[joint_addresses(SCENE)] = np.asarray(TASK.robot.zero)
    down = np.array(HOOK) - np.arange(LINKS + 1)[:, None] * [0, 0, LENGTH / LINKS]
    qpos = laid(SCENE, qpos, down + np.array([0, 1e-4, 0]) * np.arange(LINKS + 1)[:, None])
    centres = jnp.array([HOOK, (1.0, 1.0, 0.05)])
    state = at_rest(
        SCENE, jnp.asarray(qpos, jnp.float32), centres, jnp.tile(jnp.array([1.0, 0, 0, 0]), (2, 1))
    )
    return Start(graspable(SCENE, state), np.array(GOAL), (float("nan"),) * 2, 0, ())
