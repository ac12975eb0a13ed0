"""Made problems on the toy task, and models of it that know no obstacle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from doojax.geometry.frames import quaternion_from_yaw
from doojax.geometry.sdf import signed_distance
from doojax.models.protocols import above
from doojax.planning import Problem
from doojax.planning.memory import remembered
from doojax.tasks import make_task, point_goal
from doojax.tasks.toy import HEIGHT, PITCH, straight
from doojax.types import Obstacles, RopeState, ShapeKind

TOY = make_task("toy")


TRACES = []  # one entry whenever the dynamics are compiled into something


class Towed(eqx.Module):
    """The gripper gets where it is sent and the rope follows; NaN where the gripper gets too far along x.

    What differs between tests is data, so that one compiled search serves them all.
    """

    farthest: Array = eqx.field(default_factory=lambda: jnp.array(jnp.inf))

    def __call__(self, obstacles, state, action):
        TRACES.append(1)
        gripper = state.grippers[0] + action[0]

        def pull(leader, point):
            gap = point - leader
            distance = jnp.maximum(jnp.linalg.norm(gap), 1e-9)
            follower = leader + gap * jnp.minimum(1.0, PITCH / distance)
            return follower, follower

        _, behind = jax.lax.scan(pull, gripper, state.points[:-1], reverse=True)
        after = RopeState(jnp.concatenate([behind, gripper[None]]), gripper[None])
        bad = gripper[0] > self.farthest
        return jax.tree.map(lambda leaf: jnp.where(bad, jnp.nan, leaf), after), jnp.zeros(())


class Clearance(eqx.Module):
    """Accepts ropes whose points keep a distance from the wall; everything or nothing at an infinite one.

    As something learned would: luck may let pass what it does not accept.
    """

    threshold: Array

    def __call__(self, obstacles, transition):
        return above(signed_distance(obstacles, transition.next_state.points).min(), self.threshold)


CAREFUL, BLIND, TIMID = (Clearance(jnp.array(threshold)) for threshold in (0.012, -jnp.inf, jnp.inf))


def walls(*, centre=(0.15, -0.1), half=(0.02, 0.3), yaw=0.0, active=True) -> Obstacles:
    """One wall, anywhere in the plane."""
    return Obstacles(
        kind=jnp.array([ShapeKind.BOX]),
        centre=jnp.array([[*centre, HEIGHT]]),
        quaternion=quaternion_from_yaw(jnp.array([yaw])),
        half_size=jnp.array([[*half, 0.1]]),
        active=jnp.array([active]),
    )


def problem(*, start=(-0.3, 0.0), angle=0.0, goal=(-0.2, 0.2), obstacles=None, seed=0) -> Problem:
    """One problem; ``angle`` is where the gripper lies as seen from the tail."""
    points = straight(jnp.array([*start, HEIGHT]), jnp.array(angle))
    return Problem(
        obstacles=walls() if obstacles is None else obstacles,
        start=RopeState(points, points[-1:]),
        goal=point_goal(TOY, jnp.array([*goal, HEIGHT])),
        key=jax.random.key(seed),
        refuted=remembered([], 6),  # none yet; a search of a trial is compiled with it, too
    )


SIDE_BY_SIDE = 3  # in every test, so that one compiled search serves them all


def batch(*problems: Problem) -> Problem:
    """Problems side by side, filled up with some that are solved already."""
    solved = [problem(start=(-0.3, 0.0), goal=(-0.5, 0.0)) for _ in range(SIDE_BY_SIDE - len(problems))]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems, *solved)


def element(tree, index: int):
    """One of a batch, on the host."""
    return jax.tree.map(lambda leaf: np.asarray(leaf[index]), tree)
