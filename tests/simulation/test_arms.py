"""Arms in a scene: where their kinematics say, as fast as told, with a rope that they grasp and let go."""

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.robots import DUAL_ARM, dual_arm, tool_poses
from doojax.simulation.build import build_model
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.simulation.grasps import graspable, grasped, released, rope_point
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Arms, Gripper, Scene, SolverSettings
from doojax.simulation.state import at_rest
from tests.simulation.scenes import no_start

ROBOT = dual_arm()
BASE = (0.0, 0.0, 0.445)  # the stand reaches from the floor to 10 cm below it
SCENE = Scene(
    name="arms",
    rope_model=RopeModel("capsule_chain", 15),
    rope=RopeParameters(1.0, 0.01, 0.36, bending_stiffness=4e-3, bending_damping=1.5e-3),
    grippers=(),
    timestep=0.004,
    substeps=50,
    viscosity=1.0,
    solver=SolverSettings(cone="pyramidal"),
    arms=Arms(str(DUAL_ARM), ("left", "right"), BASE),
    grasps=True,
)
SIMULATOR = MujocoSimulator(SCENE, start=no_start)
DRIVER = SCENE.driver
NAMES = DRIVER.joints


def begin():
    """Arms at zero, a straight rope 2 m in front of them on the floor."""
    qpos = np.zeros(SCENE.nq, np.float32)
    rope = SCENE.layout.places["rope"]
    qpos[rope.qpos] = [SCENE.rope_part.root_offset, 2.0, 0.01, 1, 0, 0, 0]
    return graspable(SCENE, at_rest(SCENE, jnp.asarray(qpos), jnp.zeros((0, 3)), jnp.zeros((0, 4))))


def rolled(state, velocities):
    batch = jax.tree.map(lambda leaf: leaf[None], state)
    last, seen = SIMULATOR.rollout(batch, jnp.asarray(velocities, jnp.float32)[None])
    assert not seen.faults.any()
    return jax.tree.map(lambda leaf: leaf[0], last)


def driven(state):
    return np.asarray(state.qpos[SCENE.layout.driven])


def robot_joints(state) -> jnp.ndarray:
    found = jnp.zeros(20).at[jnp.array([ROBOT.joints.index(name) for name in NAMES])].set(driven(state))
    for side in ("left", "right"):  # the second finger follows the first
        at = ROBOT.joints.index
        found = found.at[at(f"{side}_finger_2")].set(found[at(f"{side}_finger_1")])
    return found


def test_arms_stay_where_they_are_and_go_where_they_are_sent():
    state = rolled(begin(), np.zeros((10, 18)))
    assert np.abs(driven(state)).max() < 0.02  # gravity over stiffness
    speeds = np.zeros(18)
    speeds[NAMES.index("torso_yaw")], speeds[NAMES.index("right_elbow")] = 0.2, -0.3
    speeds[NAMES.index("left_forearm")] = 1.0
    after = rolled(state, np.tile(speeds, (5, 1)))
    moved = driven(after) - driven(state)
    assert moved == pytest.approx(speeds, abs=0.04)  # in one second, but for what a target is ahead
    assert np.abs(np.asarray(after.commanded) - driven(after)).max() < 0.06
    tools = SIMULATOR.observe(after).grippers - np.array(BASE)
    assert np.asarray(tools) == pytest.approx(np.asarray(tool_poses(ROBOT, robot_joints(after))[0]), abs=1e-4)


def test_speeds_and_ranges_are_kept():
    fast = np.zeros(18)
    fast[NAMES.index("torso_yaw")] = 5.0  # of which 0.45 rad/s are possible
    state = begin()
    _, commanded = DRIVER.drive(SCENE, driven(state), np.zeros(18), fast, xp=np)
    assert commanded[NAMES.index("torso_yaw")] == pytest.approx(0.45 * 0.2)
    near = np.zeros(18)
    near[NAMES.index("left_shoulder_2")] = -0.14
    near_and_on = DRIVER.drive(SCENE, near, near, np.full(18, -0.4), xp=np)[1]
    assert near_and_on[NAMES.index("left_shoulder_2")] == pytest.approx(-0.15)
    behind = DRIVER.drive(SCENE, np.zeros(18), np.full(18, 0.5), np.zeros(18), xp=np)[1]
    assert behind == pytest.approx(0.02)  # a target waits for its joint
    ours = DRIVER.drive(SCENE, jnp.zeros(18), jnp.full(18, 0.5), jnp.zeros(18))[1]
    assert np.asarray(ours) == pytest.approx(behind)


def test_a_tool_holds_the_rope_and_lets_it_go():
    state = begin()
    tools = np.asarray(SIMULATOR.observe(state).grippers)
    rope = SCENE.layout.places["rope"]
    place = 0.3
    start = [
        tools[0, 0] + (0.5 - place) * 1.0 + SCENE.rope_part.root_offset,
        tools[0, 1],
        tools[0, 2],
        1,
        0,
        0,
        0,
    ]
    held = grasped(SCENE, rolled_from(state, rope.qpos, start), 0, place)
    after = rolled(held, np.zeros((15, 18)))
    seen = SIMULATOR.observation(after)
    gap = float(jnp.linalg.norm(rope_point(SCENE, seen, place) - seen.hands[0]))
    assert gap < 2e-3  # and it hangs from there
    assert float(seen.state.points[:, 2].max()) == pytest.approx(BASE[2] + 0.2622, abs=0.02)
    free = released(SCENE, after, 0)
    fallen = SIMULATOR.observation(rolled(free, np.zeros((2, 18))))
    assert float((seen.state.points - fallen.state.points).mean(0)[2]) > 0.04  # through a viscous medium
    assert float(jnp.linalg.norm(rope_point(SCENE, fallen, place) - fallen.hands[0])) > 0.04


def rolled_from(state, addresses, values):
    import equinox as eqx

    return eqx.tree_at(
        lambda s: s.qpos, state, state.qpos.at[jnp.asarray(addresses)].set(jnp.asarray(values))
    )


def test_arms_stand_alone():
    hand = Gripper(link=None, end=0, radius=0.02, max_force=10.0, max_speed=0.2)
    with pytest.raises(ValueError, match="'both' has arms and 1 free hands: expected arms alone"):
        Scene("both", SCENE.rope_model, SCENE.rope, (hand,), arms=SCENE.arms)


# A robot as files of others are: position controllers that damp, shapes that are only seen.
OTHER = """
<mujoco model="other">
  <compiler autolimits="true"/>
  <option integrator="implicitfast" timestep="0.001" gravity="0 0 -1"/>
  <worldbody>
    <body name="upper" pos="0 0 0.2">
      <joint name="shoulder" axis="0 0 1" range="-120 120"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
      <geom type="sphere" size="0.2" mass="0" contype="0" conaffinity="0"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="0 0 1" range="-60 60"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03" mass="0.5"/>
        <site name="tip" pos="0.25 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="500" kv="100" ctrlrange="-2 2" forcerange="-150 150"/>
    <position name="elbow" joint="elbow" kp="200" kv="40" inheritrange="1"/>
  </actuator>
</mujoco>
"""


def scene_with(tmp_path, text: str, tool: str = "tip") -> Scene:
    path = tmp_path / "robot.xml"
    path.write_text(text)
    return Scene(
        name="other",
        rope_model=SCENE.rope_model,
        rope=SCENE.rope,
        grippers=(),
        timestep=0.004,
        substeps=50,
        solver=SolverSettings(cone="pyramidal"),
        arms=Arms(str(path), (tool,)),
    )


def test_position_controllers_of_a_users_file_follow_velocities(tmp_path):
    scene = scene_with(tmp_path, OTHER)
    simulator = MujocoSimulator(scene, start=no_start)
    qpos = np.zeros(scene.nq, np.float32)
    qpos[scene.layout.places["rope"].qpos] = [0, 2.0, 0.01, 1, 0, 0, 0]
    state = at_rest(scene, jnp.asarray(qpos), jnp.zeros((0, 3)), jnp.zeros((0, 4)))
    states = jax.tree.map(lambda leaf: leaf[None], state)
    last, seen = simulator.rollout(states, jnp.tile(jnp.array([0.5, -0.8]), (1, 5, 1)))
    assert not seen.faults.any()
    # in a second; damping alone would leave them 0.1 and 0.16 behind
    assert np.asarray(seen.states.joints[0, -1]) == pytest.approx([0.5, -0.8], abs=0.03)
    expected = [0.3 * np.cos(0.5) + 0.25 * np.cos(-0.3), 0.3 * np.sin(0.5) + 0.25 * np.sin(-0.3), 0.2]
    assert np.asarray(seen.states.grippers[0, -1, 0]) == pytest.approx(expected, abs=0.02)
    last, seen = simulator.rollout(last, jnp.tile(jnp.array([0.0, -1.0]), (1, 4, 1)))
    assert float(seen.states.joints[0, -1, 1]) == pytest.approx(-np.pi / 3, abs=0.01)  # as far as its range
    with warnings.catch_warnings(action="error"):
        model = build_model(scene)
    assert model.opt.timestep == 0.004 and model.opt.gravity[2] == -9.81  # the scene's
    seen_only = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
    assert [model.geom_conaffinity[g] for g in seen_only] == [0]


def test_what_a_users_file_lacks_is_told(tmp_path):
    with pytest.raises(ValueError, match=r"has no tool 'hand': expected one of its sites, tip"):
        build_model(scene_with(tmp_path, OTHER, "hand"))
    elbow = '<position name="elbow" joint="elbow" kp="200" kv="40" inheritrange="1"/>'
    motor = OTHER.replace(elbow, '<motor name="pull" joint="elbow"/>')
    with pytest.raises(ValueError, match=r"actuator 'pull' of .* does not make a joint follow a target"):
        build_model(scene_with(tmp_path, motor))
    still = OTHER[: OTHER.index("<actuator>")] + "</mujoco>"
    with pytest.raises(ValueError, match=r"has no actuators: give each joint .* a position or intvelocity"):
        build_model(scene_with(tmp_path, still))
