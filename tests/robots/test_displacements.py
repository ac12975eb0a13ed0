"""Tools go straight where they are sent; at limits and before obstacles they stop."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.robots import clearance, displaced, dual_arm, read_robot, tool_poses, velocities
from doojax.types import Obstacles

ROBOT = dual_arm()
MOVING = tuple(i for i, name in enumerate(ROBOT.joints) if "finger" not in name)
# arms a little out, since at zero the elbows are 5.5 mm from the torso, and bent
BENT = {"left_shoulder_2": 0.25, "right_shoulder_2": -0.25, "left_elbow": -0.6, "right_elbow": -0.6}
ELBOWS = jnp.array([BENT.get(name, 0.0) for name in ROBOT.joints])
WALL = Obstacles(
    jnp.zeros(1, int),
    jnp.array([[0.0, 0.75, 0.6]]),
    jnp.array([[1.0, 0, 0, 0]]),
    jnp.array([[1.0, 0.05, 0.5]]),
    jnp.ones(1, bool),
)
MARGIN = 0.005
RUN = jax.jit(
    jax.vmap(partial(displaced, ROBOT, moving=MOVING, margin=MARGIN, floor=-0.445, longest=0.3), (0, 0, None))
)

PLANAR = """
<mujoco>
  <compiler autolimits="true"/>
  <worldbody>
    <body name="upper" pos="0 0 0.3">
      <joint name="shoulder" axis="0 0 1" range="-120 120"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="0 0 1" range="-150 150"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03"/>
        <site name="tip" pos="0.25 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.slow
def test_an_arm_of_two_links_goes_straight_to_where_closed_forms_have_it(tmp_path):
    """One move is free, one into a wall at y = 0.42, one beyond reach, one from beyond a limit."""
    (tmp_path / "planar.xml").write_text(PLANAR)
    robot = read_robot(tmp_path / "planar.xml", ("tip",))
    wall = Obstacles(
        jnp.zeros(1, int),
        jnp.array([[0.3, 0.52, 0.3]]),
        jnp.array([[1.0, 0, 0, 0]]),
        jnp.array([[0.5, 0.1, 0.5]]),
        jnp.ones(1, bool),
    )
    starts = jnp.array([[0.0, 1.5], [0.0, 1.5], [-0.7, 0.9], [0.0, 2.7]])
    moves = jnp.array([[[-0.05, 0.04, 0.0]], [[0.0, 0.2, 0.0]], [[0.3, -0.3, 0.0]], [[0.01, 0.0, 0.0]]])
    run = jax.jit(jax.vmap(lambda at, move: displaced(robot, at, move, wall, (0, 1), MARGIN, longest=0.3)))
    after = run(starts, moves)
    begin, end = (
        np.asarray(jax.vmap(lambda q: tool_poses(robot, q)[0][0])(q)) for q in (starts, after.joints)
    )
    assert float(after.part[0]) == 1
    np.testing.assert_allclose(end[0] - begin[0], moves[0, 0], atol=2e-3)
    cosine = (np.sum(end[0, :2] ** 2) - 0.3**2 - 0.25**2) / (2 * 0.3 * 0.25)  # of the elbow, by its triangle
    assert float(after.joints[0, 1]) == pytest.approx(np.arccos(cosine), abs=1e-4)
    for case in (1, 2):  # both stop on the way, still on the straight line
        part = float(after.part[case])
        assert 0 < part < 1
        move = np.asarray(moves[case, 0])
        move = move * min(1, 0.3 / np.linalg.norm(move))  # 0.42 m are shortened to 0.3 m
        np.testing.assert_allclose(end[case] - begin[case], part * move, atol=3e-3)
    gaps = [float(clearance(robot, joints, wall)) for joints in after.joints_on_the_way[1]]
    assert min(gaps) > MARGIN and gaps[-1] < MARGIN + 0.025
    # the arm reaches 0.55 m
    assert 0.52 < np.linalg.norm(end[2, :2]) < 0.55
    assert float(after.part[3]) == 0 and (after.joints[3] == starts[3]).all()


@pytest.fixture(scope="module")
def found():
    """A move of both; one into the wall; one out of reach; one of joints beyond their limits."""
    moves = jnp.array(
        [
            [[0.03, 0.0, 0.06], [-0.04, -0.05, 0.0]],
            [[0.0, 0.3, 0.0], [0.0, 0.3, 0.0]],
            [[-3.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
            [[0.03, 0.0, 0.0], [0.0, 0.0, 0.0]],
        ]
    )
    starts = jnp.stack([ELBOWS, ELBOWS, ELBOWS, ELBOWS.at[ROBOT.joints.index("left_elbow")].set(1.2)])
    return starts, moves, RUN(starts, moves, WALL)


def tools(joints):
    return np.asarray(tool_poses(ROBOT, joints)[0])


@pytest.mark.slow  # the same of two arms
def test_tools_go_straight_to_where_they_are_sent(found):
    starts, moves, after = found
    assert float(after.part[0]) == 1
    np.testing.assert_allclose(tools(after.joints[0]), tools(starts[0]) + np.asarray(moves[0]), atol=2e-3)
    way = after.joints_on_the_way[0]
    for number, joints in enumerate(way):
        part = (number + 1) / len(way)
        np.testing.assert_allclose(tools(joints), tools(starts[0]) + part * np.asarray(moves[0]), atol=2e-3)
    still = np.setdiff1d(np.arange(20), MOVING)
    np.testing.assert_array_equal(after.joints[0][still], starts[0][still])


@pytest.mark.slow  # the same of two arms
def test_they_stop_before_what_they_would_touch(found):
    starts, _, after = found
    assert 0 < float(after.part[1]) < 1
    least = min(float(clearance(ROBOT, joints, WALL, -0.445)) for joints in after.joints_on_the_way[1])
    assert least > MARGIN
    moved = tools(after.joints[1]) - tools(starts[1])
    np.testing.assert_allclose(moved[0], moved[1], atol=4e-3)  # at the same part of their ways
    # one step farther they would be too near: a step is 2 cm
    assert float(clearance(ROBOT, after.joints[1], WALL, -0.445)) < MARGIN + 0.025


@pytest.mark.slow  # the same of two arms
def test_limits_are_kept(found):
    starts, _, after = found
    assert ((after.joints[:3] >= ROBOT.low) & (after.joints[:3] <= ROBOT.high)).all()
    assert float(after.part[3]) == 0 and (after.joints[3] == starts[3]).all()
    # 0.3 m to the side is as far as one move goes
    assert np.linalg.norm(tools(after.joints[2])[0] - tools(starts[2])[0]) <= 0.3 + 2e-3


def test_velocities_lead_there_or_the_same_way_more_slowly():
    after = ELBOWS.at[0].add(0.03).at[1].add(-0.06)
    found = velocities(ROBOT, ELBOWS, after, 0.2)
    assert np.asarray(ELBOWS + 0.2 * found) == pytest.approx(np.asarray(after), abs=1e-6)
    slow = velocities(ROBOT, ELBOWS, after, 0.05)  # of which 0.45 rad/s are possible, not 1.2
    assert np.asarray(slow[:2]) == pytest.approx([0.225, -0.45], rel=1e-5)
