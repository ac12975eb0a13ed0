"""What the bench of inverse kinematics calls reached is reached, and mink gets the same poses and starts."""

import jax
import numpy as np
import pytest

from doojax.benchmarks.kinematics import SETTINGS, Mink, Poses, is_there, kinematics, ours, reachable
from doojax.keys import generator
from doojax.robots import dual_arm


def test_reached_is_what_mujoco_says_within_the_limits():
    poses = reachable("right", True, 4)
    robot = dual_arm()
    random = generator(0, "bench", "kinematics", "right", "turned")
    joints = random.uniform(np.clip(robot.low, -np.pi, np.pi), np.clip(robot.high, -np.pi, np.pi), (4, 20))
    assert is_there(poses, joints).all()
    beyond = joints.copy()
    beyond[0, robot.joints.index("right_forearm")] += 4 * np.pi  # the same pose
    beyond[1, robot.joints.index("right_elbow")] += 0.01  # some 4 mm, at the least
    beyond[2, robot.joints.index("right_wrist_2")] += 0.02  # rad, about the tool's own axis
    beyond[3, robot.joints.index("left_elbow")] -= 0.1  # the other arm's
    assert is_there(poses, beyond).tolist() == [False, False, False, True]
    assert is_there(poses._replace(turned=False), beyond).tolist() == [False, False, True, True]


def test_mink_solves_what_ours_solves():
    pytest.importorskip("mink")
    poses, keys = reachable("left", False, 4), jax.random.split(jax.random.key(1), 4)
    found = Mink("left", False).all(poses, keys)
    assert is_there(poses, found).all()
    far = Poses("left", False, poses.positions[:1] + 5, poses.quaternions[:1])
    assert not is_there(far, Mink("left", False).all(far, jax.random.split(jax.random.key(2), 1))).any()


@pytest.mark.slow
def test_ours_are_there():
    poses = reachable("left", False, 70)
    assert is_there(poses, ours(dual_arm(), poses)).mean() >= 0.98


def test_too_few_poses_are_refused():
    with pytest.raises(ValueError, match="there are 0 poses, expected at least 1"):
        kinematics(poses=0)
    assert SETTINGS.tolerance == 1e-3
