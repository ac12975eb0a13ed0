"""Arms carry hands to where they can be, and nowhere else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.models.arms import ArmsFeasible
from doojax.robots import clearance, dual_arm, tool_poses
from doojax.types import Obstacles, RopeState, Transition

ROBOT = dual_arm()
MOVING = tuple(i for i, name in enumerate(ROBOT.joints) if "finger" not in name)
ELBOWS = [ROBOT.joints.index(f"{side}_elbow") for side in ("left", "right")]
STARTS = jnp.zeros((2, 20)).at[1, jnp.array(ELBOWS)].set(-1.0)
BASE, YAW = (0.3, -0.2, 0.445), -np.pi / 2  # its front is to the world's +x
JUDGE = ArmsFeasible(ROBOT, STARTS, BASE, YAW, MOVING, margin=0.002)


def world(places):
    """Of the base's frame."""
    x, y, z = np.moveaxis(np.asarray(places), -1, 0)
    return np.stack([y, -x, z], -1) + BASE


def postures(count: int) -> np.ndarray:
    random = np.random.default_rng(0).uniform(-0.3, 0.3, (count, 20)).astype(np.float32)
    random[:, [i for i in range(20) if i not in MOVING]] = 0
    random[:, ELBOWS] -= 0.5
    random[:, [ROBOT.joints.index(f"{side}_shoulder_2") for side in ("left", "right")]] += (
        0.3,
        -0.3,
    )  # outwards
    return random


def boxes(centre, active=True) -> Obstacles:
    return Obstacles(
        jnp.zeros(1, int),
        jnp.asarray(centre, jnp.float32)[None],
        jnp.array([[1.0, 0, 0, 0]]),
        jnp.full((1, 3), 0.1),
        jnp.array([active]),
    )


@jax.jit
@jax.vmap
def judged(hands, obstacles):
    state = RopeState(jnp.zeros((3, 3)), hands)
    return JUDGE(obstacles, Transition(state, hands, state, jnp.zeros(())))


def many(hands, obstacles):
    hands = jnp.asarray(hands, jnp.float32)
    return judged(hands, jax.tree.map(lambda leaf: jnp.stack([leaf] * len(hands)), obstacles))


def test_hands_where_arms_are_free_are_accepted_and_elsewhere_impossible():
    joints = postures(12)
    free = np.asarray(jax.jit(jax.vmap(lambda q: clearance(ROBOT, q, ROBOT.base, -BASE[2])))(joints)) > 0.004
    assert free.sum() > 5
    hands = world(jax.jit(jax.vmap(lambda q: tool_poses(ROBOT, q)[0]))(joints))[free][:6]
    nothing = many(hands, boxes(np.zeros(3), active=False))
    assert nothing.accepted.mean() > 0.6 and (np.asarray(nothing.score) > -5e-3).mean() > 0.8
    np.testing.assert_array_equal(nothing.accepted, nothing.possible)
    far = many(hands + np.array([3.0, 0, 0]), boxes(np.zeros(3), active=False))
    assert not far.accepted.any() and not far.possible.any()
    assert np.asarray(far.score) == pytest.approx(-2.5, abs=1.0)
    # a box around one of the hands
    for number in range(2):
        assert not bool(many(hands[number : number + 1], boxes(hands[number, 1])).accepted[0])
