"""Arms of URDF files in scenes: controllers made of the file's limits; what is missing there is told."""

import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.simulation.build import build_model
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Arms, Scene, SolverSettings
from doojax.simulation.state import at_rest
from tests.simulation.scenes import no_start

INERTIA = '<inertia ixx=".01" iyy=".02" izz=".02" ixy="0" ixz="0" iyz="0"/>'


def link(name: str, length: float, mass: float) -> str:
    """A link along x, that collides as a box."""
    middle = f'<origin xyz="{length / 2} 0 0"/>'
    shape = f'<collision>{middle}<geometry><box size="{length} 0.05 0.05"/></geometry></collision>'
    return f'<link name="{name}"><inertial>{middle}<mass value="{mass}"/>{INERTIA}</inertial>{shape}</link>'


# The first turns about z and lifts nothing, the second about y and lifts 1 kg at 15 cm: 1.5 of its 20 N m.
URDF = f"""
<robot name="two_links">
  <link name="base"/>{link("upper", 0.4, 2.0)}{link("lower", 0.3, 1.0)}<link name="hand"/>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.6"/><axis xyz="0 0 1"/><limit effort="40" velocity="1.5"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-1.2" upper="0.9" effort="20" velocity="2"/></joint>
  <joint name="wrist" type="fixed"><parent link="lower"/><child link="hand"/><origin xyz="0.3 0 0"/></joint>
</robot>
"""


def scene_of(path, text: str = URDF, tool: str = "hand") -> Scene:
    path.write_text(text)
    return Scene(
        name="two_links",
        rope_model=RopeModel("capsule_chain", 4),
        rope=RopeParameters(0.4, 0.01, 0.1, bending_stiffness=1e-3, bending_damping=1e-3),
        grippers=(),
        timestep=0.004,
        substeps=50,
        solver=SolverSettings(cone="pyramidal"),
        arms=Arms(str(path), (tool,)),
        grasps=True,
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return scene_of(tmp_path_factory.mktemp("urdf") / "two_links.urdf")


def test_a_urdf_arm_follows_velocities_and_stops_at_its_limit(scene):
    simulator = MujocoSimulator(scene, start=no_start)
    qpos = np.zeros(scene.nq, np.float32)
    qpos[scene.layout.places["rope"].qpos] = [0, 2.0, 0.01, 1, 0, 0, 0]
    start = at_rest(scene, jnp.asarray(qpos), jnp.zeros((0, 3)), jnp.zeros((0, 4)))
    # 2 s of (0.5, -0.8) rad/s: the elbow is at its limit after 1.5 s; then both as fast as they can
    speeds = np.array([[0.5, -0.8]] * 10 + [[-9.0, 9.0]] * 3, np.float32)
    _, seen = simulator.rollout(jax.tree.map(lambda leaf: leaf[None], start), jnp.asarray(speeds)[None])
    assert not seen.faults.any()
    joints = np.asarray(seen.states.joints[0])  # each 0.2 s, the start first
    moved = (joints[6] - joints[1]) / 1.0
    assert moved == pytest.approx([0.5, -0.8], rel=0.01)
    assert joints[10, 1] == pytest.approx(-1.2, abs=5e-3) and joints[9, 1] == pytest.approx(-1.2, abs=5e-3)
    assert (joints[13] - joints[12]) / 0.2 == pytest.approx([-1.5, 2.0], rel=0.02)  # the file's speeds
    yaw, pitch = joints[8]
    reach = 0.4 + 0.3 * np.cos(pitch)
    expected = [reach * np.cos(yaw), reach * np.sin(yaw), 0.6 - 0.3 * np.sin(pitch)]
    assert np.asarray(seen.states.grippers[0, 8, 0]) == pytest.approx(expected, abs=2e-3)


def test_controllers_are_made_by_the_rule_of_their_limits(scene):
    drives = {one.joint: one for one in scene.driver.drives}
    assert list(drives) == ["shoulder", "elbow"]
    assert [drives[name].speed for name in drives] == [1.5, 2.0]
    assert (drives["elbow"].low, drives["elbow"].high) == pytest.approx((-1.2, 0.9))
    assert (drives["shoulder"].low, drives["shoulder"].high) == (-np.inf, np.inf)
    # all of 20 N m at 0.02 rad; the inertia about the elbow is 0.02 + 1 kg (0.15 m)^2
    assert drives["elbow"].gain == pytest.approx(20 / 0.02)
    assert drives["elbow"].damping == pytest.approx(2 * np.sqrt(1000 * (0.02 + 0.15**2)), rel=1e-6)
    model = build_model(scene)
    force = [model.actuator(f"robot_{name}").forcerange.tolist() for name in drives]
    assert force == [[-40, 40], [-20, 20]]
    assert model.site("robot_hand").bodyid[0] == model.body("robot_hand").id
    assert model.jnt_type[model.joint("robot_elbow").id] == mujoco.mjtJoint.mjJNT_HINGE


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (' effort="40" velocity="1.5"', ' effort="40"', r"joint 'shoulder' of .* has no limit of velocity"),
        (' effort="20" velocity="2"', "", r"'elbow' of .* has no limit of effort and none of velocity"),
        (' lower="-1.2" upper="0.9"', "", r"'elbow' of .* no limit of lower and upper"),
        ('velocity="2"', 'velocity="0"', r"'elbow' of .* no limit of velocity.*positive"),
    ],
)
def test_a_joint_without_limits_is_refused(tmp_path, old, new, told):
    assert old in URDF
    with pytest.raises(ValueError, match=re.compile(told)):
        build_model(scene_of(tmp_path / "lacking.urdf", URDF.replace(old, new)))


def test_a_tool_that_a_urdf_file_lacks_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no tool 'tip': expected .* none, or bodies, base, upper, lower"):
        build_model(scene_of(tmp_path / "two_links.urdf", tool="tip"))
