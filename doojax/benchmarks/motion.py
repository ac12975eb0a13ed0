"""Motions of the dual arm among the untangling rack, beside OMPL's RRTConnect with MuJoCo's collision check.

Both get the same queries: from joints that touch nothing to others with a tool in the rack. OMPL plans one
after another, since it has no batches, and checks motions as densely as ours, by the root of the sum of
squares where ours goes by the joint that moves most, which spares it checks. Neither has more than its budget
of checks. What either calls solved is checked by MuJoCo, at all waypoints and 20 places between each two.
"""

import time
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console

from doojax.benchmarks.medians import median_row
from doojax.benchmarks.rack import FLOOR, MujocoCheck, rack
from doojax.commands import command_line
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.keys import numbered, stream
from doojax.parts import in_parts
from doojax.planning.joint_motion import MotionPlan, MotionPlanner, MotionSettings, plan_motions
from doojax.robots import dual_arm, is_free, tool_poses

SEED = 0
QUERIES = 200
ROUNDS = 3
BETWEEN = 20  # places between two waypoints that MuJoCo checks
SETTINGS = MotionSettings()
SPREAD = 1.5  # rad, of joints around zero; the torso's a third of it
INSIDE = ((-0.45, 0.45, -0.4), (0.45, 1.05, 1.0))  # m, where a tool is to be at the end


class Queries(NamedTuple):
    """Where motions begin and end."""

    starts: Float[Array, "Q J"]
    goals: Float[Array, "Q J"]


def motion(*, queries: int = QUERIES, json: bool = False, publish: Path | None = None) -> None:
    """Measure how many motions are found, and how soon, beside OMPL.

    Args:
        queries: how many, at least 2.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/robots; by default
            they are only shown.

    Raises:
        ModuleNotFoundError: OMPL is not installed; `pip install 'doojax[bench]'` does that.
        ValueError: for fewer queries.
    """
    command = command_line(motion, locals())
    if queries < 2:
        raise ValueError(f"there are {queries} queries, expected at least 2")
    ompl = Ompl()
    rows = measure(draw_queries(queries), ompl)
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    show(rows, json)


def planner() -> MotionPlanner:
    """Of the dual arm among the rack; fingers stay."""
    robot = dual_arm()
    moving = tuple(joint for joint, name in enumerate(robot.joints) if "finger" not in name)
    return MotionPlanner(robot, rack(), moving, FLOOR, SETTINGS)


def draw_queries(count: int) -> Queries:
    """Starts and goals that are free, the goals with a tool in the rack."""
    ours, obstacles = planner(), rack()
    robot, moving = ours.robot, np.array(ours.moving)
    spread = np.full(len(moving), SPREAD)
    spread[:2] /= 3
    low, high = np.maximum(robot.low[moving], -spread), np.minimum(robot.high[moving], spread)

    @jax.jit
    def drawn(key: Array) -> tuple[Array, Array, Array]:
        values = jax.random.uniform(key, (256, len(moving)), robot.low.dtype, low, high)
        joints = jnp.zeros((256, len(robot.joints)), robot.low.dtype).at[:, moving].set(values)
        free = jax.vmap(lambda one: is_free(robot, one, obstacles, 2 * SETTINGS.margin, FLOOR))(joints)
        tools = jax.vmap(partial(tool_poses, robot))(joints)[0]
        least, most = jnp.array(INSIDE)
        return joints, free, ((tools > least) & (tools < most)).all(-1).any(-1)

    starts, goals = np.zeros((0, len(robot.joints))), np.zeros((0, len(robot.joints)))
    for key in numbered(stream(SEED, "bench", "motion", "queries"), range(1000)):
        if min(len(starts), len(goals)) >= count:
            break
        joints, free, inside = map(np.asarray, drawn(key))
        goals = np.concatenate([goals, joints[free & inside]])
        starts = np.concatenate([starts, joints[free & ~inside]])
    return Queries(*(jnp.asarray(ends[:count], robot.low.dtype) for ends in (starts, goals)))


def measure(queries: Queries, ompl: "Ompl") -> list[Row]:
    """Both planners on all queries, in turns."""
    console, ours = Console(stderr=True), planner()
    size = -(-len(queries.starts) // 2)
    keys = jax.random.split(stream(SEED, "bench", "motion"), 1 + ROUNDS)

    def side_by_side(key: Array) -> MotionPlan:
        def part(starts: Array, goals: Array, number: Array) -> MotionPlan:
            return plan_motions(ours, starts, goals[:, None], jax.random.fold_in(key, number[0]))

        return in_parts(part, size, *queries, np.arange(len(queries.starts)))

    console.print("compiling", highlight=False)
    side_by_side(keys[0])
    seconds: dict[str, list[float]] = {"doojax": [], "ompl": []}
    solved: dict[str, list[float]] = {"doojax": [], "ompl": []}
    checks: dict[str, list[float]] = {"doojax": [], "ompl": []}
    refuted: dict[str, list[float]] = {"doojax": [], "ompl": []}
    judge = MujocoCheck()

    def wrong(paths: list[np.ndarray]) -> float:
        return sum(not is_path_free(path, judge) for path in paths) / max(len(paths), 1)

    for number in range(ROUNDS):
        console.print(f"round {number + 1}/{ROUNDS}", highlight=False)
        begun = time.perf_counter()
        plans = side_by_side(keys[1 + number])
        seconds["doojax"].append(time.perf_counter() - begun)
        solved["doojax"].append(float(plans.solved.mean()))
        checks["doojax"].append(float(plans.checks.mean()))
        refuted["doojax"].append(wrong(solved_paths(plans)))
        begun = time.perf_counter()
        found = [ompl.solve(*ends) for ends in zip(*map(np.asarray, queries), strict=True)]
        seconds["ompl"].append(time.perf_counter() - begun)
        solved["ompl"].append(float(np.mean([one.solved for one in found])))
        checks["ompl"].append(float(np.mean([one.checks for one in found])))
        refuted["ompl"].append(wrong([one.path for one in found if one.solved]))
    rows = []
    count = len(queries.starts)
    for name in seconds:
        tags = {"planner": name, "scene": "untangling_rack"}
        rows.append(median_row("motion_solved", tags, np.array(solved[name]), ""))
        rows.append(median_row("motion_checks", tags, np.array(checks[name]), ""))
        rows.append(median_row("motion_s", tags, np.array(seconds[name]) / count, "s"))
        rows.append(row("motion_refuted", {"by": "mujoco", **tags}, np.mean(refuted[name]), "", n=ROUNDS))
    ratio = np.array(seconds["ompl"]) / np.array(seconds["doojax"])
    tags = {"scene": "untangling_rack"}
    rows.append(median_row("motion_speedup", {"against": "ompl", **tags}, ratio, ""))
    return rows


def solved_paths(plans: MotionPlan) -> list[np.ndarray]:
    """The waypoints of those plans that are solved."""
    points, counts = np.asarray(plans.waypoints), np.asarray(plans.count)
    return [points[i, : counts[i]] for i in np.flatnonzero(np.asarray(plans.solved))]


def is_path_free(path: Float[np.ndarray, "W J"], check: MujocoCheck | None = None) -> bool:
    """Whether MuJoCo finds no contact at waypoints nor between them."""
    check = check or MujocoCheck()
    fractions = np.linspace(0, 1, BETWEEN + 2)
    return all(
        check.is_free(begin + fraction * (end - begin))
        for begin, end in pairwise(path)
        for fraction in fractions
    )


class Found(NamedTuple):
    """One search of OMPL."""

    solved: bool
    checks: int
    path: np.ndarray  # [W, J]


class Ompl:
    """OMPL's geometric::RRTConnect with `MujocoCheck` and our budget of checks."""

    def __init__(self):
        """Load OMPL and the model."""
        from ompl import util  # pyright: ignore[reportMissingImports]

        util.setLogLevel(util.LOG_ERROR)
        util.RNG.setSeed(1 + SEED)
        self._check, self._planner = MujocoCheck(), planner()
        self._moving = np.array(self._planner.moving)
        self._budget = SETTINGS.checks

    def solve(self, start: Float[np.ndarray, "J"], goal: Float[np.ndarray, "J"]) -> Found:
        """Plan until the goal is reached or the budget is spent."""
        from ompl import base, geometric  # pyright: ignore[reportMissingImports]

        moving, check = self._moving, self._check
        robot, far = self._planner.robot, SETTINGS.farthest
        begin = start[moving].astype(float)
        low = np.maximum(np.asarray(robot.low)[moving], begin - far)
        high = np.minimum(np.asarray(robot.high)[moving], begin + far)
        space: Any = base.RealVectorStateSpace(len(moving))
        bounds = base.RealVectorBounds(len(moving))
        for axis, (least, most) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
            bounds.setLow(axis, least)
            bounds.setHigh(axis, most)
        space.setBounds(bounds)
        space.setLongestValidSegmentFraction(SETTINGS.step / space.getMaximumExtent())
        joints = start.astype(float).copy()
        check.count = 0

        def is_free(state: Any) -> bool:
            joints[moving] = [state[axis] for axis in range(len(moving))]
            return check.is_free(joints)

        setup = geometric.SimpleSetup(space)
        setup.setStateValidityChecker(is_free)
        ends = []
        for values in (begin, goal[moving].astype(float)):
            state = space.allocState()
            for axis, value in enumerate(values.tolist()):
                state[axis] = value
            ends.append(state)
        setup.setStartAndGoalStates(*ends)
        setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
        setup.setup()
        setup.solve(base.PlannerTerminationCondition(lambda: check.count >= self._budget))
        solved = setup.haveExactSolutionPath()
        path = []
        if solved:
            for state in setup.getSolutionPath().getStates():
                joints[moving] = [state[axis] for axis in range(len(moving))]
                path.append(joints.copy())
        return Found(solved, check.count, np.array(path))
