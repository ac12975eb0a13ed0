"""Hands that two arms carry: what these cannot carry out is impossible, in searches and from the start.

A search for free hands is kept to hands that the dual arm, standing where the task says, can be at with its
arms free (`doojax.models.arms.ArmsFeasible`). What is executed are the free hands: no arm is simulated.
Afterwards each executed state is looked at in the same way, and the record says how many of them arms carry.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.experiments.trials.records import TrialRecord
from doojax.goals import Goal
from doojax.keys import stream
from doojax.models.arms import TOLERANCE, ArmsFeasible
from doojax.robots import IkSettings, Robot, dual_arm, inverse_kinematics
from doojax.tasks.base import Task
from doojax.types import Obstacles, State

MARGIN = 0.002  # m, that arms keep from everything that they must not touch
ROOM = 32  # states that are looked at in one piece, so that more or fewer of them compile nothing anew
# From where postures are looked for, rad, mirrored for the right arm: elbows folded, hands up before the
# shoulders, or by the sides. With more of them, hardly more of the scenes that come along can be begun.
POSTURES = (
    {"shoulder_2": 1.0, "elbow": -2.4, "shoulder_1": 0.7},
    {"shoulder_2": 0.5, "elbow": -2.4},
)
MIRRORED = {"shoulder_2"}  # of these


@runtime_checkable
class ForArms(Protocol):
    """A task that says where a robot stands whose tools carry its hands, the left one hand 0."""

    arms_base: tuple[float, float, float]  # of the robot's base, world frame, m
    arms_yaw: float  # rad


def arms_of(task: Task) -> ArmsFeasible:
    """The dual arm as a judge of a task's transitions.

    Raises:
        ValueError: the task does not say where arms stand.
    """
    if not isinstance(task, ForArms):
        raise ValueError(
            f"task {task.name!r} has no arms: it does not say where a robot stands that carries its hands "
            "(arms_base, arms_yaw), as dual_gripper does; leave --arms out"
        )
    robot = _dual_arm()
    moving = tuple(i for i, name in enumerate(robot.joints) if "finger" not in name)
    return ArmsFeasible(robot, _starts(robot), task.arms_base, task.arms_yaw, moving, MARGIN)


def refusals(arms: ArmsFeasible, task: Any, obstacles: Obstacles, states: State, goals: Goal) -> list[str]:
    """Why arms cannot begin some trials, or reach their goals, whatever is planned; "" for the others.

    A goal is out of reach where a tool stays farther from it than rope is between its hand and the point that
    is to get there. That a goal is not refused does not say that it can be reached.

    Args:
        arms: as `arms_of` makes them.
        task: whose trials they are.
        obstacles: of each, [R, M].
        states: their starts, [R].
        goals: of each, [R].
    """
    hands = states.bodies()[:, states.passive :]
    _, off, free = _in_rooms(arms, obstacles, hands)
    away = np.asarray(_away(arms, goals.targets))  # [R, T, G]
    rope = np.asarray(task.reach())[states.passive :]  # from each hand to each body
    found = []
    for row in range(len(off)):
        at_hand = off[row] <= TOLERANCE
        if not at_hand.any():
            found.append(
                f"the arms cannot be where the hands begin: a tool stays {100 * off[row].min():.0f} cm off"
            )
        elif not (at_hand & free[row]).any():
            found.append("the arms cannot be where the hands begin without touching anything")
        else:
            tolerance = float(goals.tolerance[row])
            found.append(
                _out_of_reach(arms, goals.targets[row], goals.bodies[row], away[row], rope, tolerance)
            )
    return found


def _out_of_reach(
    arms: ArmsFeasible,
    targets: Float[Array, "T 3"],
    bodies: Bool[Array, "T K"],
    away: Float[np.ndarray, "T G"],
    rope: Float[np.ndarray, "G K"],
    tolerance: float,
) -> str:
    for target, allowed, missing in zip(np.asarray(targets), np.asarray(bodies), away, strict=True):
        # of the bodies that may get there, the one to which each hand leaves most rope
        lacking = np.min(missing[:, None] - rope[:, allowed], axis=1) - tolerance - TOLERANCE
        worst = int(np.argmax(lacking))
        if lacking[worst] > 0:
            place = [round(float(value), 3) for value in target]
            return (
                f"the goal {place} is out of the arms' reach: the {arms.robot.tools[worst]} tool stays "
                f"{missing[worst]:.2f} m away, and there are {rope[worst, allowed].max():.2f} m of rope "
                "between its hand and what is to get there; choose a goal nearer to the arms"
            )
    return ""


def with_arms(record: TrialRecord, arms: ArmsFeasible) -> TrialRecord:
    """A record that says which arms its plans were kept to, and how many executed states they carry.

    ``about["arms"]`` has base, yaw, states and how many of them are ``carried``; ``replay["joints"]`` has
    postures for these, each the nearest to the one before, and NaN for the others.
    """
    count = len(record.grippers)
    every = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), record.obstacles)
    joints, off, free = _in_rooms(arms, every, jnp.asarray(record.grippers, jnp.float32))
    good = (off <= TOLERANCE) & free
    chosen = np.full((count, joints.shape[-1]), np.nan, np.float32)
    last = np.asarray(arms.starts[0])
    for state in np.flatnonzero(good.any(1)):
        travel = np.where(good[state], np.abs(joints[state] - last).max(-1), np.inf)
        last = chosen[state] = joints[state, np.argmin(travel)]
    said = {
        "robot": "dual_arm",
        "base": list(arms.base),
        "yaw": arms.yaw,
        "states": count,
        "carried": int(good.any(1).sum()),
    }
    return replace(record, about={**record.about, "arms": said}, replay={**record.replay, "joints": chosen})


def _in_rooms(
    arms: ArmsFeasible, obstacles: Obstacles, hands: Float[Array, "R G 3"]
) -> tuple[Float[np.ndarray, "R S J"], Float[np.ndarray, "R S"], Bool[np.ndarray, "R S"]]:
    """Postures of each state, by how much a tool is off then, m, and whether they are free."""
    count = len(hands)
    rows = np.resize(np.arange(count), -(-count // ROOM) * ROOM)
    parts = []
    for part in rows.reshape(-1, ROOM):
        some = jax.tree.map(lambda leaf, part=part: jnp.asarray(leaf)[part], (obstacles, hands))
        parts.append(jax.tree.map(np.asarray, _postures(arms, *some)))
    joints, off, free = (np.concatenate(leaves)[:count] for leaves in zip(*parts, strict=True))
    return joints, off, free


@eqx.filter_jit
def _postures(
    arms: ArmsFeasible, obstacles: Obstacles, hands: Float[Array, "R G 3"]
) -> tuple[Float[Array, "R S J"], Float[Array, "R S"], Bool[Array, "R S"]]:
    def one(both: tuple[Obstacles, Array]) -> tuple[Array, Array, Array]:
        joints, off = arms.postures(both[1])
        return joints, off, arms.free(both[0], joints)

    return jax.lax.map(one, (obstacles, hands), batch_size=16)


@eqx.filter_jit
def _away(arms: ArmsFeasible, targets: Float[Array, "R T 3"]) -> Float[Array, "R T G"]:
    """How near each tool, by itself, comes to each target, m; obstacles are not looked at."""
    robot, count = arms.robot, targets.shape[0] * targets.shape[1]
    keys = jax.random.split(stream(0, "arms", "reach"), (count, len(robot.tools)))

    def one(both: tuple[Array, Array]) -> Float[Array, "G"]:
        place, off = arms.seen_from_base(both[0]), []
        for tool, key in zip(robot.tools, both[1], strict=True):
            found = inverse_kinematics(robot, tool, place, arms.starts[0], key, settings=IkSettings(starts=8))
            off.append(found.error.min())
        return jnp.stack(off)

    away = jax.lax.map(one, (targets.reshape(-1, 3), keys), batch_size=16)
    return away.reshape(*targets.shape[:2], -1)


@cache
def _dual_arm() -> Robot:
    return dual_arm()


def _starts(robot: Robot, postures: Sequence[dict[str, float]] = POSTURES) -> Float[Array, "S J"]:
    found = np.zeros((len(postures), len(robot.joints)), np.float32)
    for row, posture in enumerate(postures):
        for name, angle in posture.items():
            for side, sign in (("left", 1), ("right", -1)):
                at = robot.joints.index(f"{side}_{name}")
                found[row, at] = angle * (sign if name in MIRRORED else 1)
    return jnp.asarray(found)
