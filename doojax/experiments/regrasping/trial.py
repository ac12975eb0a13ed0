"""One trial of arms, from its start to its record."""

from dataclasses import asdict
from typing import NamedTuple

import numpy as np

from doojax.experiments.regrasping.choice import REACHING, THREADING, Method
from doojax.experiments.regrasping.reaching import point_reaching
from doojax.experiments.regrasping.run import RegraspSettings, Run, Seconds
from doojax.experiments.regrasping.threading import Threading
from doojax.experiments.regrasping.world import World
from doojax.experiments.trials.records import Look, TrialRecord
from doojax.experiments.trials.replay import first_state
from doojax.keys import stream
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.tasks.arms import ArmTask, Start
from doojax.topology.linking import TOUCHING

SETTINGS = RegraspSettings()


class Trial(NamedTuple):
    """What came of a trial, and how long it took."""

    record: TrialRecord
    seconds: Seconds


def methods_of(task: ArmTask) -> tuple[Method, ...]:
    """The methods that there are for a task."""
    return THREADING if task.threads else REACHING


def check_method(task: ArmTask, method: str) -> Method:
    """The method, if it is one of the task's.

    Raises:
        ValueError: it is not.
    """
    for one in methods_of(task):
        if one == method:
            return one
    raise ValueError(f"unknown method {method!r}, expected some of {', '.join(methods_of(task))}")


def run_trial(
    task: ArmTask,
    simulator: MujocoSimulator,
    start: Start,
    method: Method,
    seed: int,
    number: int,
    settings: RegraspSettings = SETTINGS,
) -> Trial:
    """One trial in the scene with this number.

    Its record's ``about`` has ``steps`` (of control: signature, trap ratio, costs), ``regrasps`` (candidates
    with their costs, the choice, blocklist, signatures as planned and as executed), iterations, and simulated
    seconds; ``replay`` has the first state, actions, joints and where hands hold the rope, see
    `doojax.experiments.regrasping.world.repeated`.

    Raises:
        ValueError: for a method that the task has not, or a scene whose loops touch the robot or the rope.
    """
    check_method(task, method)
    world = World(task, simulator, start)
    run = Run(world, start, method, stream(seed, "regrasping", task.name, "trial", str(number)), settings)
    check_skeleton(world, run)
    reached = Threading(run).to_the_end() if task.threads else point_reaching(run)
    return Trial(record_of(run, start, seed, number, reached), run.ledger.seconds)


def check_skeleton(world: World, run: Run) -> None:
    """Refuse a scene in which signatures mean nothing from the beginning.

    Raises:
        ValueError: an obstacle loop touches the robot or the rope.
    """
    if bool(run.signature.touching):
        raise ValueError(
            f"an obstacle loop of {', '.join(world.skeleton.names)} touches an arm, the rope or the way "
            f"from the base to where it is fastened: it is {float(run.signature.margin):.3g} m away, expected"
            f" more than {TOUCHING:g} of the scene's size. Move the loop, which must lie within an obstacle, "
            "or the robot"
        )


def record_of(run: Run, start: Start, seed: int, number: int, reached: bool) -> TrialRecord:
    """All of a trial that has ended."""
    world, execution, ledger = run.world, run.execution, run.ledger
    scene, task = world.scene, world.task
    about = {
        "iterations": len(ledger.steps),
        "grasps": sum(bool(one["changed"]) for one in ledger.regrasps),
        "simulated_s": len(execution.actions) * scene.control_period,
        "scene": number,
        "attempt": start.attempt,
        "settings": asdict(run.settings),
        "skeleton": list(world.skeleton.names),
        "steps": ledger.steps,
        "regrasps": ledger.regrasps,
    }
    return TrialRecord(
        task=task.name,
        method=run.method,
        seed=seed,
        look=Look(scene.rope_part.parameters.radius, floor=0.0 if scene.floor else None),
        obstacles=world.simulator.obstacles(start.state),
        goal=run.goal,
        goal_radius=task.goal_radius,
        goal_point=round(task.keypoint * scene.links),
        points=np.stack(execution.ropes),
        grippers=np.stack(execution.hands),
        plans=(),
        events=tuple(ledger.events),
        reached=reached,
        period=scene.control_period,
        about=about,
        replay={
            **first_state(start.state),
            "actions": np.array(execution.actions, np.float32).reshape(-1, len(scene.layout.driven)),
            "held": np.array(execution.held, np.float32).reshape(-1, len(task.robot.tools)),
            "joints": np.stack(execution.joints),
        },
    )
