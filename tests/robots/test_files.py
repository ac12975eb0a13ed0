"""Robots of users' files: a URDF file's tools, limits and speeds; what is wrong with others is told."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.robots import DUAL_ARM, inverse_kinematics, read_robot, tool_poses

INERTIA = (
    '<inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
)
# Two links of 0.4 m that turn about z at 0.1 m; the tool is fixed 0.3 m along the second.
URDF = f"""
<robot name="planar">
  <link name="base"/>
  <link name="upper">{INERTIA}<collision><origin xyz="0.2 0 0" rpy="0 1.5707963 0"/>
    <geometry><cylinder radius="0.03" length="0.3"/></geometry></collision></link>
  <link name="lower">{INERTIA}</link>
  <link name="tool"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="10" velocity="1.5"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.4 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-2.5" upper="2.5" effort="5" velocity="0"/></joint>
  <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/><origin xyz="0.3 0 0"/></joint>
</robot>
"""


@pytest.fixture
def planar(tmp_path):
    path = tmp_path / "planar.urdf"
    path.write_text(URDF)
    return path


def test_a_urdf_file_has_its_tool_limits_and_speeds(planar):
    robot = read_robot(planar, ("tool",))
    assert robot.joints == ("shoulder", "elbow") and robot.tools == ("tool",)
    assert robot.low.tolist() == [-2, -2.5] and robot.high.tolist() == [2, 2.5]
    assert robot.speed.tolist() == [1.5, np.inf]  # a limit of zero is none
    place, turn = tool_poses(robot, jnp.array([0.5, -1.1]))
    expected = [0.4 * np.cos(0.5) + 0.3 * np.cos(-0.6), 0.4 * np.sin(0.5) + 0.3 * np.sin(-0.6), 0.1]
    assert np.asarray(place[0]) == pytest.approx(expected, abs=1e-6)
    assert np.asarray(turn[0]) == pytest.approx([np.cos(0.3), 0, 0, -np.sin(0.3)], abs=1e-6)
    # the cylinder: a capsule around its box
    assert np.asarray(robot.capsule_radius) == pytest.approx([0.03 * 2**0.5])
    assert np.asarray(robot.capsule_ends[:, 0, 0]) == pytest.approx([0.05, 0.35], abs=1e-6)
    solve = jax.jit(partial(inverse_kinematics, robot, "tool", key=jax.random.key(0)))
    solve(place[0], jnp.zeros(2)).check()


def test_tools_that_nobody_names_are_sites_or_what_carries_nothing(planar):
    assert read_robot(planar).tools == ("tool",)  # the only body that no other sits on; there are no sites
    assert read_robot(DUAL_ARM).tools == ("left", "right")  # its sites


def test_what_a_file_lacks_is_told(planar):
    with pytest.raises(ValueError, match=r"no tool 'hand': expected one of its sites \(\) or bodies .*tool"):
        read_robot(planar, ("hand",))
    planar.write_text(URDF.replace('"elbow" type="revolute"', '"elbow" type="floating"'))
    with pytest.raises(ValueError, match="free joint can only be used on top level"):
        read_robot(planar, ("tool",))
    planar.write_text("<robot><link")
    with pytest.raises(ValueError, match=r"(?i)xml|parse"):
        read_robot(planar, ("tool",))
