"""Inverse kinematics of the dual arm beside mink, which solves a quadratic program in each step.

Both are asked for the same poses, those of joints drawn within their limits, and start from the robot's zero
posture, then from joints drawn around it. Mink takes one pose after another, and of a pose one start after
another until one is solved, since it has no batches. Ours takes many poses at once, in parts for all
processors: first from the one start, and then those that are left from the others. MuJoCo's kinematics say of
either whether it is there.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.benchmarks.medians import median_row
from doojax.benchmarks.stages import stages
from doojax.commands import command_line
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.keys import generator, numbered, stream
from doojax.robots import DUAL_ARM, IkSettings, Robot, dual_arm, solve_poses, tool_poses
from doojax.robots.inverse import starts_around

SEED = 0
POSES = 1000
ROUNDS = 5
SETTINGS = IkSettings(starts=16)
PLACES, TURNS = (False, True)


class Poses(NamedTuple):
    """Where a tool is to be."""

    tool: str
    turned: bool  # whether its orientation counts
    positions: Float[Array, "N 3"]  # m
    quaternions: Float[Array, "N 4"]


def kinematics(*, poses: int = POSES, json: bool = False, publish: Path | None = None) -> None:
    """Measure how often and how soon inverse kinematics finds joints, beside mink.

    Args:
        poses: how many of each arm, at least one.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/robots; by default
            they are only shown.

    Raises:
        ModuleNotFoundError: mink is not installed; `pip install 'doojax[bench]'` does that.
        ValueError: for none.
    """
    command = command_line(kinematics, locals())
    if poses < 1:
        raise ValueError(f"there are {poses} poses, expected at least 1")
    asked = [(tool, turned) for tool in dual_arm().tools for turned in (PLACES, TURNS)]
    parts = [(f"{tool} arm, {'pose' if turned else 'place'}", (tool, turned)) for tool, turned in asked]
    rows = [one for part in stages("kinematics", parts) for one in measure(reachable(*part, poses))]
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    show(rows, json)


def reachable(tool: str, turned: bool, count: int) -> Poses:
    """Poses of a tool for joints drawn evenly within their limits, or within half a turn of zero."""
    robot = dual_arm()
    low, high = np.clip(robot.low, -np.pi, np.pi), np.clip(robot.high, -np.pi, np.pi)
    random = generator(SEED, "bench", "kinematics", tool, "turned" if turned else "any")
    joints = jnp.asarray(random.uniform(low, high, (count, len(low))), robot.low.dtype)
    positions, quaternions = jax.jit(jax.vmap(partial(tool_poses, robot)))(joints)
    index = robot.tool(tool)
    return Poses(tool, turned, positions[:, index], quaternions[:, index])


def measure(poses: Poses) -> list[Row]:
    """Seconds of either for all poses, in turns, and what share of them is reached."""
    keys = numbered(stream(SEED, "bench", "kinematics", "starts"), range(len(poses.positions)))
    solvers: dict[str, Callable[[], np.ndarray]] = {
        "doojax": partial(ours, dual_arm(), poses),
        "mink": partial(Mink(poses.tool, poses.turned).all, poses, keys),
    }
    rows, medians = [], {}
    times = {name: np.zeros(ROUNDS) for name in solvers}
    joints = {name: solve() for name, solve in solvers.items()}  # compiles ours
    for number in range(ROUNDS):
        for name, solve in solvers.items():
            begun = time.perf_counter()
            solve()
            times[name][number] = time.perf_counter() - begun
    for name in solvers:
        tags = {"solver": name, "tool": poses.tool, "goal": "pose" if poses.turned else "place"}
        reached = is_there(poses, joints[name])
        rows.append(row("ik_success", tags, reached.mean(), "", n=len(reached)))
        rows.append(median_row("ik_us", tags, 1e6 * times[name] / len(reached), "us"))
        medians[name] = rows[-1].value
    tags = {"against": "mink", "tool": poses.tool, "goal": "pose" if poses.turned else "place"}
    return [*rows, row("ik_speedup", tags, medians["mink"] / medians["doojax"], "")]


def ours(robot: Robot, poses: Poses) -> np.ndarray:
    """The joints that we find for each pose."""
    key = stream(SEED, "bench", "kinematics", "ours")
    turns = poses.quaternions if poses.turned else None
    found = solve_poses(robot, poses.tool, poses.positions, robot.zero, key, turns, SETTINGS)
    return np.asarray(found.joints[:, 0])


def is_there(poses: Poses, joints: Float[np.ndarray, "N J"]) -> Bool[np.ndarray, "N"]:
    """Whether joints are within their limits and MuJoCo has the tool within the tolerances."""
    model = mujoco.MjModel.from_xml_path(str(DUAL_ARM))
    data, turn, apart = mujoco.MjData(model), np.zeros(4), np.zeros(3)
    found = np.zeros(len(joints), bool)
    low, high = model.jnt_range.T
    for pose, values in enumerate(joints):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        site = data.site(poses.tool)
        off = np.linalg.norm(site.xpos - np.asarray(poses.positions[pose]))
        mujoco.mju_mat2Quat(turn, site.xmat)
        mujoco.mju_subQuat(apart, turn, np.asarray(poses.quaternions[pose], float))
        turned = np.linalg.norm(apart) if poses.turned else 0
        inside = (values >= low - 1e-5) & (values <= high + 1e-5)
        found[pose] = inside.all() and off <= SETTINGS.tolerance and turned <= SETTINGS.angle_tolerance
    return found


class Mink:
    """Mink's differential inverse kinematics, step after step until the tool is there."""

    def __init__(self, tool: str, turned: bool):
        """Load the robot, and mink."""
        import mink  # pyright: ignore[reportMissingImports]

        self._mink: Any = mink
        model = mujoco.MjModel.from_xml_path(str(DUAL_ARM))
        self._configuration = mink.Configuration(model)
        cost = SETTINGS.angle_weight if turned else 0.0
        self._task = mink.FrameTask(tool, "site", position_cost=1.0, orientation_cost=cost, lm_damping=0.1)
        self._limits = [mink.ConfigurationLimit(model)]
        self._turned = turned
        robot = dual_arm()
        chain = np.array(robot.chain(robot.tool_links[robot.tool(tool)]))
        self._starts = jax.jit(lambda key: starts_around(robot, chain, robot.zero, key, SETTINGS.starts))
        self._chain = chain

    def all(self, poses: Poses, keys: Array) -> np.ndarray:
        """Joints for each pose: the first that solve, or where the last start led."""
        positions, quaternions = np.asarray(poses.positions, float), np.asarray(poses.quaternions, float)
        starts = np.asarray(jax.vmap(self._starts)(keys), float)
        return np.array([self.one(*pose) for pose in zip(positions, quaternions, starts, strict=True)])

    def one(self, position: np.ndarray, quaternion: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Joints for one pose."""
        mink, configuration, task = self._mink, self._configuration, self._task
        task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3(quaternion), position))
        for start in starts:
            joints = np.zeros(configuration.model.nq)
            joints[self._chain] = start
            configuration.update(joints)
            for _ in range(SETTINGS.iterations):
                if self._there(task.compute_error(configuration)):
                    return configuration.q.copy()
                velocity = mink.solve_ik(
                    configuration, [task], 1.0, "daqp", damping=1e-6, limits=self._limits
                )
                configuration.integrate_inplace(velocity, 1.0)
            if self._there(task.compute_error(configuration)):
                break
        return configuration.q.copy()

    def _there(self, error: np.ndarray) -> bool:
        close = np.linalg.norm(error[:3]) <= SETTINGS.tolerance
        return bool(close and (not self._turned or np.linalg.norm(error[3:]) <= SETTINGS.angle_tolerance))
