"""Planning problems, the trees that a search grows for them, and the plans that trees hold."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from doojax.geometry.sdf import signed_distance
from doojax.goals import Goal
from doojax.planning.memory import Refuted
from doojax.planning.protocols import Task
from doojax.types import Obstacles, State

Status = Literal["solved", "exhausted", "stuck"]


_distances = jax.jit(jax.vmap(signed_distance))


class Problem(eqx.Module):
    """From where to where among what; the first axis of every leaf counts problems in a batch."""

    obstacles: Obstacles
    start: State  # or a subclass that carries along what the dynamics need
    goal: Goal
    key: Array
    refuted: Refuted | None = None  # outcomes that were not as predicted


class Tree(eqx.Module):
    """Everything that was tried; C slots, of which the first ``used`` are filled."""

    state: State  # [C]
    action: Float[Array, "..."]  # [*b, C, ...], that led here
    parent: Int[Array, "*b C"]  # -1 for the start
    accepted: Bool[Array, "*b C"]
    score: Float[Array, "*b C"]  # as the reliability gave it; NaN for the start
    goal_distance: Float[Array, "*b C"]  # m
    spread: Float[Array, "*b C"]  # m, by which a body may be off, by the uncertainties of all steps
    reached: Bool[Array, "*b C"]  # near enough to the goal, with room for the spread
    used: Int[Array, "*b"]
    solved: Bool[Array, "*b"]
    stuck: Bool[Array, "*b"]  # nothing that was tried from the start was accepted


class Plan(NamedTuple):
    """The way through a tree to the node nearest to the goal, of those that reached it if any did."""

    status: Status
    nodes: Int[np.ndarray, "m"]  # slots from the start on
    actions: Float[np.ndarray, "t ..."]  # m - 1
    states: State  # predicted, [m]
    goal_distance: float  # m, predicted at the end
    extensions: int  # tried, those of shortcuts included
    accepted: int


def check_problem(task: Task, problem: Problem) -> None:
    """Refuse one problem that nobody could solve.

    Raises:
        ValueError: the goal cannot be reached, see `require_reachable`, or the start is inside an obstacle.
    """
    require_reachable(task, *jax.tree.map(lambda leaf: leaf[None], (problem.obstacles, problem.goal)))
    distance = np.asarray(signed_distance(problem.obstacles, problem.start.bodies()))
    if not (distance > 0).all():
        body = int(np.argmin(distance))
        points = problem.start.passive
        name = f"point {body} of the rope" if body < points else f"gripper {body - points}"
        raise ValueError(
            f"the scene is in collision at the start: {name} is {-100 * distance[body]:.1f} cm inside an "
            "obstacle; move the rope or the obstacle"
        )


def require_reachable(task: Task, obstacles: Obstacles, goals: Goal) -> None:
    """Refuse goals, a batch [B] of them and of what is in their way, that nothing could reach.

    Raises:
        ValueError: a target lies outside of the task's workspace or inside an obstacle, or two targets are
            farther apart than the rope between the bodies that are to reach them is long.
    """
    targets, tolerance = np.asarray(goals.targets), np.asarray(goals.tolerance)
    inside = np.asarray(task.workspace.contains(goals.targets))
    depth = -np.asarray(_distances(obstacles, goals.targets))
    reach = np.asarray(task.reach())
    for goal, bodies in enumerate(np.asarray(goals.bodies)):
        for one, target in enumerate(targets[goal]):
            place = [round(float(value), 3) for value in target]
            if not inside[goal, one]:
                raise ValueError(
                    f"the goal {place} lies outside of the workspace of {task.name}: "
                    f"expected a point between {task.workspace.low} and {task.workspace.high} (m)"
                )
            if depth[goal, one] > 0:
                raise ValueError(
                    f"the goal {place} lies {100 * depth[goal, one]:.1f} cm inside an obstacle: expected a "
                    "point that is free"
                )
            for other in range(one):
                apart = float(np.linalg.norm(target - targets[goal, other]))
                longest = float(reach[np.ix_(bodies[one], bodies[other])].max())
                if apart > longest + 2 * tolerance[goal]:
                    raise ValueError(
                        f"the goal {place} and another are {apart:.2f} m apart, expected at most "
                        f"{longest:.2f} m: the rope between what is to reach them is not longer"
                    )


def plan_of(tree: Tree) -> Plan:
    """The plan that one problem's tree holds: to the node that reached the goal, or came nearest to it."""
    host = jax.tree.map(np.asarray, tree)
    used = int(host.used)
    ends = host.reached[:used] if host.reached[:used].any() else host.accepted[:used]
    best = int(np.argmin(np.where(ends, host.goal_distance[:used], np.inf)))
    nodes = [best]
    while host.parent[nodes[-1]] >= 0:
        nodes.append(int(host.parent[nodes[-1]]))
    nodes = np.array(nodes[::-1])
    accepted = int(host.accepted[1:used].sum())
    return Plan(
        status="solved" if host.solved else "stuck" if host.stuck else "exhausted",
        nodes=nodes,
        actions=host.action[nodes[1:]],
        states=jax.tree.map(lambda leaf: leaf[nodes], host.state),
        goal_distance=float(host.goal_distance[best]),
        extensions=used - 1,
        accepted=accepted,
    )
