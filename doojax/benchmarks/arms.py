"""One MPPI command for the dual arm, which holds a cable of 15 links by one tool, on MuJoCo C.

The thesis's settings: 50 samples, 15 controls of 0.2 s, 750 physics steps each. The cost brings the cable's
end to a place beside the robot.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from doojax.benchmarks.medians import median_row
from doojax.experiments.reports.rows import Row
from doojax.keys import numbered, stream
from doojax.planning import Mppi, SimulatedRollouts
from doojax.planning.costs import THESIS_WEIGHTS, reaching, smoothness, summed, unstable, weighted
from doojax.planning.mppi import PRESETS
from doojax.robots import DUAL_ARM, dual_arm
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.simulation.grasps import graspable, grasped
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Arms, Scene, SolverSettings
from doojax.simulation.state import SimState, at_rest

SEED = 0
COMMANDS = 10
HELD = 0.7  # along the cable
SCENE = Scene(
    name="arm_reaching",
    rope_model=RopeModel("capsule_chain", 15),
    rope=RopeParameters(1.0, 0.01, 0.36, bending_stiffness=4e-3, bending_damping=1.5e-3, friction=1.0),
    grippers=(),
    timestep=0.004,
    substeps=50,
    viscosity=1.0,
    solver=SolverSettings(cone="pyramidal"),
    arms=Arms(str(DUAL_ARM), ("left", "right"), (0.0, 0.0, 0.445)),
    grasps=True,
)
GOAL = (0.3, 0.6, 0.9)  # m


def held_cable() -> SimState:
    """The arms at zero, the right tool holding the cable, which lies level and is about to hang down."""
    qpos = np.zeros(SCENE.nq)
    tool = np.array(SCENE.arms.position) + np.array([0.2197, 0.5933, 0.2622]) if SCENE.arms else np.zeros(3)
    along = SCENE.rope_part.root_offset + (0.5 - HELD) * SCENE.rope_part.parameters.length
    qpos[SCENE.layout.places["rope"].qpos] = [tool[0] + along, tool[1], tool[2], 1, 0, 0, 0]
    start = at_rest(SCENE, jnp.asarray(qpos, jnp.float32), jnp.zeros((0, 3)), jnp.zeros((0, 4)))
    return grasped(SCENE, graspable(SCENE, start), 1, HELD)


def controller(simulator: MujocoSimulator) -> Mppi:
    """With the thesis's settings and weights."""
    goal = jnp.array(GOAL)
    terms = {
        "reaching": summed(lambda tried, _: reaching(tried.seen.points[-1], goal)),
        "hand": summed(lambda tried, _: reaching(tried.seen.grippers[1], goal)),
        "smoothness": weighted(THESIS_WEIGHTS["smoothness"], smoothness),
        "unstable": weighted(THESIS_WEIGHTS["unstable"], summed(lambda tried, _: unstable(tried.faults))),
    }
    robot = dual_arm()
    names = [robot.joints.index(name) for name in simulator.scene.driver.joints]  # pyright: ignore
    speed = robot.speed[np.array(names)]
    return Mppi(SimulatedRollouts(simulator, speed.shape), terms, -speed, speed, PRESETS["thesis"])


def command_rows() -> list[Row]:
    """Milliseconds of a command, each with the control of the one before executed."""
    simulator = MujocoSimulator(SCENE, start=_no_start)
    mppi, state = controller(simulator), held_cable()
    nominal, seconds = mppi.start(), np.zeros(COMMANDS)
    for number, key in enumerate(numbered(stream(SEED, "bench", "mppi", "arms"), range(COMMANDS + 1))):
        begun = time.perf_counter()
        nominal, report = mppi(nominal, state, key)
        jax.block_until_ready(nominal)
        if number:  # the first compiles
            seconds[number - 1] = time.perf_counter() - begun
        report.check()
        state = simulator.step(state, nominal.controls[0])
        nominal = nominal.advanced()
    tags = {"task": "arm_reaching", "implementation": "doojax", "settings": "thesis"}
    return [median_row("mppi_ms", tags, 1e3 * seconds, "ms")]


def _no_start(key: Array) -> SimState:
    raise ValueError("the bench makes its own start")
