"""Kinematics beside MuJoCo's, Jacobians beside finite differences, for the dual arm and an odd tree."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.robots import DUAL_ARM, Robot, dual_arm, link_poses, read_robot, tool_jacobians, tool_poses

# A slide, two joints on one body, turned frames, anchors off the body, a zero that is not zero, a weld.
ODD = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom type="cylinder" size="0.1 0.2" pos="0 0 -0.3"/>
    <body pos="0.1 0.2 0.3" euler="0.3 -0.4 1.1">
      <joint name="lift" type="slide" axis="1 2 -1" range="-0.2 0.5"/>
      <joint name="swing" axis="0 1 1" pos="0.05 -0.1 0.02" ref="0.4"/>
      <geom type="box" size="0.05 0.1 0.02" euler="0 1 0"/>
      <body pos="0.2 0 0.1" quat="0.3 0.1 -0.8 0.2">
        <joint name="turn" axis="1 0 0" pos="0 0 0.1" range="-2 2"/>
        <geom type="sphere" size="0.03" pos="0 0 0.2"/>
        <body pos="0 0.3 0" euler="1 0 0"><site name="tip" pos="0.1 0 0" euler="0 0.5 0.2"/></body>
      </body>
      <body name="branch" pos="-0.2 0 0"><joint name="other" axis="0 0 1"/><geom size="0.02"/></body>
    </body>
  </worldbody>
</mujoco>
"""
ARMS = dual_arm()
ODD_MODEL = mujoco.MjModel.from_xml_string(ODD)
ROBOTS = {
    "dual arm": (ARMS, mujoco.MjModel.from_xml_path(str(DUAL_ARM))),
    "odd": (read_robot(ODD_MODEL, ("tip", "branch")), ODD_MODEL),
}
robots = pytest.mark.parametrize("name", ROBOTS)


def within_limits(robot: Robot, count: int, seed: int = 0) -> np.ndarray:
    low, high = np.clip(robot.low, -3, 3), np.clip(robot.high, -3, 3)
    return np.random.default_rng(seed).uniform(low, high, (count, len(low))).astype(np.float32)


@robots
def test_poses_are_mujocos_at_1000_random_states(name):
    robot, model = ROBOTS[name]
    joints = within_limits(robot, 1000)
    positions, quaternions = map(np.asarray, jax.jit(jax.vmap(lambda q: tool_poses(robot, q)))(joints))
    anchors = np.asarray(jax.jit(jax.vmap(lambda q: link_poses(robot, q)[0]))(joints))
    hinges = ~np.array(robot.slides)  # a slide's anchor in MuJoCo is where its own motion begins
    data = mujoco.MjData(model)
    for row, values in enumerate(joints):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        assert np.abs(anchors[row] - data.xanchor)[hinges].max() < 1e-5
        for tool, label in enumerate(robot.tools):
            seen = data.body(label) if label == "branch" else data.site(label)
            assert np.abs(positions[row, tool] - seen.xpos).max() < 1e-5
            turned = np.zeros(4)
            mujoco.mju_mat2Quat(turned, seen.xmat.ravel())
            assert abs(turned @ quaternions[row, tool]) == pytest.approx(1, abs=1e-5)


@robots
def test_jacobians_are_finite_differences(name):
    robot, model = ROBOTS[name]
    joints = within_limits(robot, 5, seed=1)
    found = np.asarray(jax.jit(jax.vmap(lambda q: tool_jacobians(robot, q)))(joints))[:, 0]
    data, step = mujoco.MjData(model), 1e-6

    def tool_at(values):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        seen = data.site(robot.tools[0])
        return seen.xpos.copy(), seen.xmat.reshape(3, 3).copy()

    for values, matrix in zip(joints.astype(float), found, strict=True):
        for joint in range(len(values)):
            change = np.zeros(len(values))
            change[joint] = step
            (ahead, turned), (behind, back) = tool_at(values + change), tool_at(values - change)
            spin = (turned - back) / (2 * step) @ tool_at(values)[1].T  # the matrix of the cross product
            expected = [*(ahead - behind) / (2 * step), spin[2, 1], spin[0, 2], spin[1, 0]]
            assert matrix[:, joint] == pytest.approx(expected, abs=1e-4)


def test_the_dual_arm_is_the_thesiss():
    assert len(ARMS.joints) == 20 and ARMS.tools == ("left", "right")
    for link in ARMS.tool_links:
        chain = [ARMS.joints[j] for j in ARMS.chain(link)]
        assert chain[:2] == ["torso_yaw", "torso_pitch"] and len(chain) == 9
    positions, quaternions = map(np.asarray, tool_poses(ARMS, jnp.zeros(20)))
    assert positions[0] == pytest.approx([-0.2257, 0.5933, 0.2622], abs=1e-6)
    assert positions[1] == pytest.approx([0.2197, 0.5933, 0.2622], abs=1e-6)
    half = 0.5**0.5  # the tools' z points along +y
    assert quaternions == pytest.approx(np.array([[half, -half, 0, 0]] * 2), abs=1e-6)
    at = ARMS.joints.index
    assert float(ARMS.high[at("right_shoulder_2")]) == pytest.approx(0.15)
    assert float(ARMS.low[at("left_elbow")]) == -4
    assert float(ARMS.speed[at("left_wrist_2")]) == pytest.approx(3.1)
    assert float(ARMS.speed[at("left_finger_2")]) == np.inf  # it follows the other finger


def test_what_is_no_robot_is_refused():
    with pytest.raises(ValueError, match=r"no tool 'hand': expected one of its sites \(left, right\)"):
        read_robot(DUAL_ARM, ("hand",))
    floating = "<mujoco><worldbody><body name='b'><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    with pytest.raises(ValueError, match="'joint0' is neither a hinge nor a slide"):
        read_robot(mujoco.MjModel.from_xml_string(floating), ("b",))
    with pytest.raises(ValueError, match="unknown tool 'hand', expected one of left, right"):
        ARMS.tool("hand")
