"""How the arms of `doojax.tasks.arm_reaching` are controlled, and trials of it.

MPPI with the thesis's settings: 50 samples, 15 controls of 0.2 s, physics steps of 0.004 s, so 750 of them
for each sample. With our own: fewer and shorter samples that change slowly, and steps of 0.01 s. And what
looks at nothing but where the goal is: the tool goes straight, as far as the arms are free.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.keys import numbered, stream
from doojax.planning import Mppi, SimulatedRollouts
from doojax.planning.costs import THESIS_WEIGHTS, reaching, smoothness, summed, unstable, weighted
from doojax.planning.mppi import PRESETS, MppiSettings, Nominal, Report
from doojax.planning.simulated import Tried
from doojax.robots import Robot, are_free, displaced, velocities
from doojax.simulation.scenes import Scene
from doojax.simulation.state import Fault, SimState
from doojax.tasks.arm_reaching import HAND, ArmReaching, Reaching, scene
from doojax.tasks.arms import BASE
from doojax.types import Obstacles

SEED = 0
LONGEST = 60  # commands of a trial: 12 s
NEAR = 0.01  # m, from which on arms pay for being near to something
BROKEN = int(Fault.NOT_FINITE | Fault.UNSTABLE | Fault.PASSED_THROUGH)
OURS = MppiSettings(samples=24, horizon=8, temperature=0.1, noise=0.25, duration=0.2, knots=3)
SETTINGS = {"thesis": (scene(0.004, 50), PRESETS["thesis"]), "doojax": (scene(), OURS)}

# once, so that all scenes share what is compiled
SMOOTHNESS = weighted(THESIS_WEIGHTS["smoothness"], smoothness)
UNSTABLE = weighted(THESIS_WEIGHTS["unstable"], summed(lambda tried, _: unstable(tried.faults & BROKEN)))


def cable_end(points: Float[Array, "*b N 3"]) -> Float[Array, "*b 3"]:
    """Where the cable ends, from its links' centres (m), but for the bend of half a link."""
    last, before = points[..., -1, :], points[..., -2, :]
    return last + (last - before) / 2


class EndAtGoal(eqx.Module):
    """A term: metres between the cable's end and its goal, summed."""

    goal: Float[Array, "3"]

    def __call__(self, tried: Tried, controls: Float[Array, "H U"]) -> Float[Array, ""]:
        """See `doojax.planning.mppi.Term`."""
        return jax.vmap(lambda end: reaching(end, self.goal))(cable_end(tried.seen.points)).sum()


class ArmsNear(eqx.Module):
    """A term: the weight of contacts for each state in which arms are nearer than `NEAR` to something."""

    robot: Robot
    obstacles: Obstacles  # base's frame

    def __call__(self, tried: Tried, controls: Float[Array, "H U"]) -> Float[Array, ""]:
        """See `doojax.planning.mppi.Term`."""
        free = are_free(self.robot, tried.seen.joints, self.obstacles, NEAR, -BASE[2])
        return THESIS_WEIGHTS["contacts"] * (~free).sum()


class JointRollouts:
    """Rollouts of velocities of all joints but fingers, which stay."""

    def __init__(self, task: ArmReaching):
        """Of one task's simulator."""
        self._inner = SimulatedRollouts(task.simulator, (task.scene.layout.driven.size,))
        self._task = task

    def whole(self, controls: Float[Array, "*b U"]) -> Float[Array, "*b A"]:
        """Actions of the scene."""
        found = np.zeros((*controls.shape[:-1], self._task.scene.layout.driven.size), np.float32)
        found[..., self._task.actuated] = np.asarray(controls)
        return jnp.asarray(found)

    def many(self, state: SimState, controls: Float[Array, "K H U"], durations: Float[Array, "K"]) -> Tried:
        """See `doojax.planning.mppi.HostRollouts`."""
        return self._inner.many(state, self.whole(controls), durations)


type Command = Callable[[SimState, Array], Float[Array, "A"]]
"""The scene's next action, in some state, with a key for what is random."""


class Sampled:
    """MPPI in one scene, warm from command to command."""

    def __init__(self, task: ArmReaching, drawn: Reaching, settings: MppiSettings):
        """Begin with the plan to do nothing."""
        self.rollouts = JointRollouts(task)
        terms = {
            "reaching": EndAtGoal(jnp.asarray(drawn.goal, jnp.float32)),
            "near": ArmsNear(task.robot, task.obstacles(drawn.state)),
            "smoothness": SMOOTHNESS,
            "unstable": UNSTABLE,
        }
        speed = task.robot.speed[task.moving]
        self.mppi = Mppi(self.rollouts, terms, -speed, speed, settings)
        self.nominal = self.mppi.start()
        self.last: tuple[Nominal, Report] | None = None  # plan, as it was when its first control was given

    def planned(self, state: SimState, key: Array) -> tuple[Nominal, Report]:
        """One plan, finished when it returns."""
        return jax.block_until_ready(self.mppi(self.nominal, state, key))

    def __call__(self, state: SimState, key: Array) -> Float[Array, "A"]:
        """See `Command`."""
        found, report = self.planned(state, key)
        self.last = found, report
        self.nominal = found.advanced()
        return self.rollouts.whole(found.controls[0])


class Straight:
    """The tool goes straight by what the cable's end lacks, and stops before arms would touch anything."""

    def __init__(self, task: ArmReaching, drawn: Reaching):
        """Of one scene."""
        self._task, self._goal, self._obstacles = task, drawn.goal, task.obstacles(drawn.state)

    def __call__(self, state: SimState, key: Array) -> Float[Array, "A"]:
        """See `Command`."""
        task, seen = self._task, self._task.simulator.observation(state)
        moves = jnp.zeros((len(task.robot.tools), 3)).at[HAND].set(self._goal - task.end(seen))
        return displacing(task, seen.state.joints, moves, self._obstacles)


def displacing(
    task: ArmReaching, joints: Float[Array, "J"], moves: Float[Array, "T 3"], obstacles: Obstacles
) -> Float[Array, "A"]:
    """The action that displaces tools (m), as far as they can go in a control period and arms are free."""
    moving, period = tuple(map(int, task.moving)), task.scene.control_period
    found = _towards(task.robot, joints, moves, obstacles, moving, period)
    return JointRollouts(task).whole(found[task.moving])


@eqx.filter_jit
def _towards(
    robot: Robot, joints: Array, moves: Array, obstacles: Obstacles, moving: tuple[int, ...], period: float
) -> Float[Array, "J"]:
    found = displaced(robot, joints, moves, obstacles, moving, floor=-BASE[2])
    return velocities(robot, joints, found.joints, period)


class Method(NamedTuple):
    """How to control, in a scene of which physics steps."""

    scene: Scene
    control: Callable[[ArmReaching, Reaching], Command]


def _by_sampling(name: str) -> Method:
    own, settings = SETTINGS[name]
    return Method(own, lambda task, drawn: Sampled(task, drawn, settings))


METHODS = {
    "mppi": _by_sampling("doojax"),
    "mppi_thesis": _by_sampling("thesis"),
    "straight": Method(scene(), Straight),
}


class Trial(NamedTuple):
    """What came of one scene."""

    drawn: Reaching
    reached: bool
    states: list[SimState]  # each after its command, the start first

    @property
    def commands(self) -> int:
        """How many were executed."""
        return len(self.states) - 1


def trial(
    task: ArmReaching,
    drawn: Reaching,
    number: int,
    method: Method,
    watch: Callable[[Command, SimState, Array], None] | None = None,
) -> Trial:
    """Control until the cable's end is at its goal, the simulation breaks, or `LONGEST` commands are over.

    Args:
        task: in which.
        drawn: the scene.
        number: of the scene, by which what is random in the trial is drawn.
        method: of control.
        watch: called with what commanded, the state that it saw, and the action, before that is executed.
    """
    command, states = method.control(task, drawn), [drawn.state]
    for key in numbered(stream(SEED, "bench", "arms", str(number)), range(LONGEST)):
        if task.reached(states[-1], drawn.goal):
            break
        action = command(states[-1], key)
        if watch is not None:
            watch(command, states[-1], action)
        states.append(task.simulator.step(states[-1], action))
        if int(states[-1].faults) & BROKEN:
            return Trial(drawn, False, states)
    return Trial(drawn, task.reached(states[-1], drawn.goal), states)


def distances(task: ArmReaching, done: Trial) -> Any:
    """Of the cable's end from its goal after each command, m."""
    ends = [task.end(task.simulator.observation(state)) for state in done.states]
    return np.linalg.norm(np.asarray(ends) - done.drawn.goal, axis=-1)
