"""Arms carry hands to where they can be, and nowhere else."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.models.arms import ArmsFeasible
from doojax.robots import clearance, read_robot, tool_poses
from doojax.types import Obstacles, RopeState, Transition
from tests.robots.small_arms import SMALL, STARTS

ROBOT = read_robot(mujoco.MjModel.from_xml_string(SMALL))
BASE, YAW = (0.3, -0.2, 0.9), -np.pi / 2  # its front is to the world's -y
JUDGE = ArmsFeasible(ROBOT, STARTS, BASE, YAW, tuple(range(6)), margin=0.002)
BATCH = 6


def world(places):
    """Of the base's frame."""
    x, y, z = np.moveaxis(np.asarray(places), -1, 0)
    return np.stack([y, -x, z], -1) + BASE


def boxes(*centres) -> Obstacles:
    """A box for each of a batch, and for those that are left none."""
    places = np.zeros((BATCH, 1, 3), np.float32)
    places[: len(centres), 0] = np.reshape(centres, (-1, 3))
    return Obstacles(
        jnp.zeros((BATCH, 1), int),
        jnp.asarray(places),
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (BATCH, 1, 1)),
        jnp.full((BATCH, 1, 3), 0.1),
        jnp.arange(BATCH)[:, None] < len(centres),
    )


@jax.jit
@jax.vmap
def judged(hands, obstacles):
    state = RopeState(jnp.zeros((3, 3)), hands)
    return JUDGE(obstacles, Transition(state, hands, state, jnp.zeros(())))


@jax.jit
@jax.vmap
def seen(joints):
    return tool_poses(ROBOT, joints)[0], clearance(ROBOT, joints, ROBOT.base, -BASE[2])


@pytest.mark.slow
def test_hands_where_arms_are_free_are_accepted_and_elsewhere_impossible():
    random = np.random.default_rng(0)
    joints = np.asarray(STARTS)[random.integers(0, 2, 12)] + random.uniform(-0.3, 0.3, (12, 6))
    joints[:, [2, 5]] = np.abs(joints[:, [2, 5]])  # elbows bend one way
    places, distance = map(np.asarray, seen(jnp.asarray(joints, jnp.float32)))
    hands = world(places[distance > 0.004])[:BATCH].astype(np.float32)
    assert len(hands) == BATCH
    nothing = judged(hands, boxes())
    assert nothing.accepted.mean() > 0.6 and (np.asarray(nothing.score) > -5e-3).mean() > 0.8
    np.testing.assert_array_equal(nothing.accepted, nothing.possible)
    far = judged(hands + np.array([3.0, 0, 0], np.float32), boxes())
    assert not far.accepted.any() and not far.possible.any()
    assert np.asarray(far.score) == pytest.approx(-2.5, abs=1.0)
    around_a_hand = judged(hands, boxes(*hands[:3, 1]))
    assert np.asarray(nothing.accepted)[:3].any() and not around_a_hand.accepted[:3].any()
    np.testing.assert_array_equal(around_a_hand.accepted[3:], nothing.accepted[3:])
